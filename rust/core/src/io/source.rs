//! The bytes of a file, as a decoder sees them.

use std::fs::File;
use std::io::{Error, Read, Result, Seek, SeekFrom};
use std::path::Path;

use crate::control::Control;

/// Bytes read at once, so that cancelling does not wait for a large frame from a slow disk.
const PIECE: usize = 1 << 22;

/// Bytes of a TIFF header: byte order, version, offset of the first directory.
const HEADER: usize = 8;

/// No lossless coding in use here packs tighter: a header that claims more is forged or broken, and
/// memory for it must not even be asked for.
pub(super) const MAX_COMPRESSION: usize = 4096;

/// A file that stops being readable when the work is cancelled, and whose TIFF header can be made
/// to point at any page: so each page has a decoder of its own, and they work in parallel.
pub(super) struct Source<'c> {
    file: File,
    length: usize,
    position: u64,
    header: Option<[u8; HEADER]>,
    control: &'c Control,
}

impl<'c> Source<'c> {
    /// Opens the file, at the TIFF directory at the offset `directory` if there is one.
    pub(super) fn open(path: &Path, directory: Option<u32>, control: &'c Control) -> Result<Self> {
        let mut file = File::open(path)?;
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Err(Error::other("it is not a regular file"));
        }
        let length = usize::try_from(metadata.len()).unwrap_or(usize::MAX);
        let header = match directory {
            Some(offset) => Some(header_at(&mut file, offset)?),
            None => None,
        };
        Ok(Self { file, length, position: 0, header, control })
    }

    /// Size of the file in bytes.
    pub(super) fn length(&self) -> usize {
        self.length
    }
}

/// The header of a TIFF file with the offset of the first directory replaced.
fn header_at(file: &mut File, offset: u32) -> Result<[u8; HEADER]> {
    let mut header = [0; HEADER];
    file.read_exact(&mut header)?;
    file.rewind()?;
    let little_endian = header.starts_with(b"II");
    let offset = if little_endian { offset.to_le_bytes() } else { offset.to_be_bytes() };
    header[4..].copy_from_slice(&offset);
    Ok(header)
}

impl Read for Source<'_> {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize> {
        self.control.check().map_err(Error::other)?;
        let wanted = bytes.len().min(PIECE);
        let read = self.file.read(&mut bytes[..wanted])?;
        if let Some(header) = &self.header {
            let rest = header.get(self.position as usize..).unwrap_or_default();
            bytes[..read].iter_mut().zip(rest).for_each(|(byte, &patched)| *byte = patched);
        }
        self.position += read as u64;
        Ok(read)
    }
}

impl Seek for Source<'_> {
    fn seek(&mut self, position: SeekFrom) -> Result<u64> {
        self.position = self.file.seek(position)?;
        Ok(self.position)
    }
}
