//! Numbers to little-endian bytes and back.

/// What can be kept as bytes, and be read into a value of the same sizes.
pub trait Bytes {
    /// Appends the value.
    fn write(&self, bytes: &mut Vec<u8>);
    /// Takes the value that was written; None where bytes are missing.
    fn read(&mut self, reader: &mut Reader<'_>) -> Option<()>;
}

/// Bytes that are read one after the other.
#[derive(Debug)]
pub struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    pub(super) const fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    pub(super) const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    pub(super) fn number<T: Bytes + Default>(&mut self) -> Option<T> {
        let mut number = T::default();
        number.read(self)?;
        Some(number)
    }
}

macro_rules! numbers {
    ($($number:ty)*) => {$(
        impl Bytes for $number {
            fn write(&self, bytes: &mut Vec<u8>) {
                bytes.extend(self.to_le_bytes());
            }

            fn read(&mut self, reader: &mut Reader<'_>) -> Option<()> {
                let taken = reader.take(size_of::<Self>())?;
                *self = Self::from_le_bytes(taken.try_into().ok()?);
                Some(())
            }
        }
    )*};
}

numbers!(u32 u64 u128 f64);

impl<T: Bytes> Bytes for Vec<T> {
    fn write(&self, bytes: &mut Vec<u8>) {
        self.iter().for_each(|each| each.write(bytes));
    }

    fn read(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        self.iter_mut().try_for_each(|each| each.read(reader))
    }
}
