//! Pages of TIFF files.

use std::collections::HashSet;
use std::io::{BufRead, BufReader, Seek, SeekFrom};

use tiff::decoder::ifd::Value;
use tiff::decoder::{ChunkType, Decoder, DecodingSampleType, Limits};
use tiff::tags::{CompressionMethod, PhotometricInterpretation, Tag};
use tiff::{ColorType, TiffError};

use super::source::{MAX_COMPRESSION, Source};
use super::{Depth, Format, Outcome, Problem};
use crate::frames::Shape;

/// Version number of TIFF files with 64-bit offsets, in either byte order.
const BIG_TIFF_LITTLE: &[u8] = &[43, 0];
const BIG_TIFF_BIG: &[u8] = &[0, 43];

/// Directory entry of MetaMorph stacks, whose frames have no directories.
const UIC2: Tag = Tag::Unknown(33629);

/// Exposure time in s, of DNG in the directory of the page, of other files in that of EXIF.
const EXPOSURE_TIME: Tag = Tag::Unknown(33434);

/// Bits of `NewSubfileType`: a reduced copy of another page, or a mask.
const NOT_A_FRAME: u32 = 0b101;

/// Memory of a value of a directory while it is decoded, over its bytes in the file.
const DECODED: usize = size_of::<Value>();

impl From<TiffError> for Problem {
    fn from(error: TiffError) -> Self {
        match error {
            TiffError::IoError(error) => error.into(),
            // Limits are there against forged sizes, but a very large image may meet them too.
            TiffError::LimitsExceeded => Self::Unsupported("a page this large".into()),
            TiffError::UnsupportedError(error) => Self::Unsupported(error.to_string()),
            _ => Self::Bad(format!("is not a readable TIFF: {error}"), Some(error.into())),
        }
    }
}

type PageDecoder<'c> = Decoder<BufReader<Source<'c>>>;

/// Offsets of all directories, which are the pages.
pub(super) fn directories(source: Source) -> Outcome<Vec<u32>> {
    let mut decoder = decoder(source)?;
    let mut offsets = Vec::new();
    let mut seen = HashSet::new();
    let mut next = decoder.ifd_pointer();
    while let Some(pointer) = next {
        let offset =
            u32::try_from(pointer.0).map_err(|_| Problem::bad("has a page beyond 4 GiB"))?;
        if !seen.insert(offset) {
            return Err(Problem::bad("is broken: its pages follow one another in a circle"));
        }
        offsets.push(offset);
        next = decoder.read_directory(pointer)?.next();
    }
    if hides_frames(&mut decoder, offsets.len()) {
        return Err(Problem::Unsupported(
            "a stack with a directory for its first frame only".into(),
        ));
    }
    Ok(offsets)
}

/// Some writers put many frames behind one directory and say so in words (ImageJ, tifffile) or in
/// an entry of their own (MetaMorph).
fn hides_frames(decoder: &mut PageDecoder, pages: usize) -> bool {
    let description = decoder.get_tag_ascii_string(Tag::ImageDescription).unwrap_or_default();
    let images = || description.lines().find_map(|line| line.strip_prefix("images=")?.parse().ok());
    let imagej = description.starts_with("ImageJ=") && images().is_some_and(|n: usize| n > pages);
    let shaped = description.starts_with('{') && description.contains("\"truncated\"");
    imagej || shaped || decoder.image_ifd().find_entry(UIC2).is_some()
}

/// Exposure time in s that the first page holds.
pub(super) fn exposure_s(source: Source) -> Outcome<Option<f64>> {
    let mut decoder = decoder(source)?;
    let mut found = decoder.find_tag(EXPOSURE_TIME)?;
    if found.is_none()
        && let Some(exif) = decoder.find_tag(Tag::ExifDirectory)?
    {
        let directory = decoder.read_directory(exif.into_ifd_pointer()?)?;
        found = decoder.read_directory_tags(&directory).find_tag(EXPOSURE_TIME)?;
    }
    Ok(match found {
        Some(Value::Rational(over, under)) if under != 0 => {
            Some(f64::from(over) / f64::from(under))
        }
        _ => None,
    })
}

/// The decoder of a file's first page.
fn decoder(source: Source) -> Outcome<PageDecoder> {
    let length = source.length();
    let mut reader = BufReader::new(source);
    if matches!(reader.fill_buf()?.get(2..4), Some(BIG_TIFF_LITTLE | BIG_TIFF_BIG)) {
        return Err(Problem::Unsupported("BigTIFF".into()));
    }
    check_directory(&mut reader, length)?;
    let decoder = Decoder::new(reader)?;
    let mut limits = Limits::default();
    // A strip, or the value of an entry, cannot be larger than the file.
    limits.intermediate_buffer_size = length;
    limits.decoding_buffer_size = length.saturating_mul(DECODED);
    Ok(decoder.with_limits(limits))
}

/// Refuses a first directory with values larger than the file: the decoder takes memory for them
/// before it has limits.
fn check_directory(reader: &mut (impl BufRead + Seek), length: usize) -> Outcome<()> {
    let start = reader.fill_buf()?;
    let little = start.starts_with(b"II");
    if !little && !start.starts_with(b"MM") {
        return Ok(()); // the decoder says what it misses
    }
    let mut head = [0; 8];
    reader.read_exact(&mut head)?;
    let short = |b: &[u8]| {
        let bytes = [b[0], b[1]];
        if little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) }
    };
    let long = |b: &[u8]| {
        let bytes = [b[0], b[1], b[2], b[3]];
        if little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) }
    };
    reader.seek(SeekFrom::Start(long(&head[4..]).into()))?;
    let mut count = [0; 2];
    reader.read_exact(&mut count)?;
    for _ in 0..short(&count) {
        let mut entry = [0; 12]; // tag, type, count, value or its place
        reader.read_exact(&mut entry)?;
        let size: u64 = match short(&entry[2..]) {
            3 | 8 => 2,
            4 | 9 | 11 | 13 => 4,
            5 | 10 | 12 | 16..=18 => 8,
            _ => 1,
        };
        if size * u64::from(long(&entry[4..])) > length as u64 {
            return Err(Problem::bad("is broken: an entry of a page is larger than the file"));
        }
    }
    reader.rewind()?;
    Ok(())
}

/// A page of a TIFF file.
pub(super) struct Picture<'c> {
    decoder: PageDecoder<'c>,
    format: Format,
}

impl<'c> Picture<'c> {
    /// The first page that `source` shows.
    pub(super) fn new(source: Source<'c>) -> Outcome<Self> {
        let mut decoder = decoder(source)?;
        check_role(&mut decoder)?;
        check_chunks(&mut decoder)?;
        let format = Format { shape: shape(&mut decoder)?, depth: depth(&mut decoder)? };
        check_coding(&mut decoder, format)?;
        Ok(Self { decoder, format })
    }
}

impl super::Picture for Picture<'_> {
    fn format(&self) -> Format {
        self.format
    }

    fn decode(mut self: Box<Self>, bytes: &mut [u8]) -> Outcome<()> {
        Ok(self.decoder.read_image_bytes(bytes)?)
    }
}

/// Refuses what is no frame of its own, rather than leave it out of the mean or let it in.
fn check_role(decoder: &mut PageDecoder) -> Outcome<()> {
    let kind: u32 = decoder.find_tag_unsigned(Tag::NewSubfileType)?.unwrap_or(0);
    let old_kind: u32 = decoder.find_tag_unsigned(Tag::SubfileType)?.unwrap_or(1);
    let has_copies = decoder.image_ifd().find_entry(Tag::SubIfd).is_some();
    if kind & NOT_A_FRAME != 0 || old_kind == 2 || has_copies {
        return Err(Problem::bad(
            "holds a reduced copy or a mask beside its frames, expected frames only: \
             export them to a file of their own",
        ));
    }
    Ok(())
}

/// Refuses tiles and strips that no file of this length holds: a row of one is decoded at once.
fn check_chunks(decoder: &mut PageDecoder) -> Outcome<()> {
    let length = decoder.inner().get_ref().length() as u64;
    let (cols, _) = decoder.chunk_dimensions();
    let samples: u16 = decoder.find_tag_unsigned(Tag::SamplesPerPixel)?.unwrap_or(1);
    if u64::from(cols) * u64::from(samples) / MAX_COMPRESSION as u64 > length {
        return Err(Problem::bad(format!(
            "claims rows of {cols} pixels in a file of {length} bytes"
        )));
    }
    Ok(())
}

fn shape(decoder: &mut PageDecoder) -> Outcome<Shape> {
    let (cols, rows) = decoder.dimensions()?;
    Ok(Shape::new(rows as usize, cols as usize))
}

fn depth(decoder: &mut PageDecoder) -> Outcome<Depth> {
    match (decoder.colortype()?, decoder.image_buffer_layout()?.sample_type) {
        (ColorType::Gray(8), Some(DecodingSampleType::U8)) => Ok(Depth::Eight),
        (ColorType::Gray(16), Some(DecodingSampleType::U16)) => Ok(Depth::Sixteen),
        (ColorType::Gray(bits), _) => Err(Problem::Unsupported(format!("this {bits}-bit format"))),
        (colour, _) => Err(Problem::bad(format!("is {colour:?}, expected one grey channel"))),
    }
}

/// Admits lossless codings that every reader decodes to the same numbers.
fn check_coding(decoder: &mut PageDecoder, format: Format) -> Outcome<()> {
    let photometric: Option<u16> = decoder.find_tag_unsigned(Tag::PhotometricInterpretation)?;
    if photometric == Some(PhotometricInterpretation::WhiteIsZero.to_u16()) {
        return Err(Problem::bad("has white at 0 (MinIsWhite), expected black at 0"));
    }
    if decoder.find_tag_unsigned::<u16>(Tag::FillOrder)?.unwrap_or(1) != 1 {
        return Err(Problem::Unsupported("a reversed bit order".into()));
    }
    let number = decoder.find_tag_unsigned(Tag::Compression)?.unwrap_or(1);
    match CompressionMethod::from_u16_exhaustive(number) {
        CompressionMethod::None => check_sizes(decoder, format),
        CompressionMethod::LZW
        | CompressionMethod::Deflate
        | CompressionMethod::OldDeflate
        | CompressionMethod::PackBits => Ok(()),
        method => Err(Problem::Unsupported(format!("compression {method:?}"))),
    }
}

/// Refuses uncompressed strips and tiles that are too short: what follows them in the file would
/// be taken for pixels.
fn check_sizes(decoder: &mut PageDecoder, format: Format) -> Outcome<()> {
    let strips = decoder.get_chunk_type() == ChunkType::Strip;
    let tag = if strips { Tag::StripByteCounts } else { Tag::TileByteCounts };
    let sizes: Vec<u64> = decoder.find_tag_unsigned_vec(tag)?.unwrap_or_default();
    let sample = (format.bytes() / format.shape.len().max(1)) as u64;
    for (index, &size) in sizes.iter().enumerate() {
        let data = decoder.chunk_data_dimensions(index as u32);
        let (cols, rows) = if strips { data } else { decoder.chunk_dimensions() };
        if size < u64::from(cols) * u64::from(rows) * sample {
            return Err(Problem::bad("is broken: a strip or tile is shorter than its pixels"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::{Problem, Source, directories};
    use crate::control::Control;

    /// A TIFF of one page of 2×2 pixels, with one more entry: type, count and place of its values.
    fn file(name: &str, tag: u16, kind: u16, count: u32) -> std::path::PathBuf {
        let entries =
            [(256, 4, 2), (257, 4, 2), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8)];
        let mut entries: Vec<_> = entries.map(|(tag, kind, value)| (tag, kind, 1, value)).into();
        entries.extend([(277, 3, 1, 1), (278, 4, 1, 2), (279, 4, 1, 4), (tag, kind, count, 8)]);
        entries.sort_unstable();
        let mut bytes = b"II\x2a\0\x0c\0\0\0\x01\x02\x03\x04".to_vec();
        bytes.extend((entries.len() as u16).to_le_bytes());
        for (tag, kind, count, value) in entries {
            bytes.extend([tag, kind].map(u16::to_le_bytes).concat());
            bytes.extend([count, value].map(u32::to_le_bytes).concat());
        }
        bytes.extend([0; 4]);
        let path = std::env::temp_dir().join(format!("{}-{name}.tif", std::process::id()));
        std::fs::write(&path, bytes).unwrap();
        path
    }

    fn problem(path: &Path) -> Option<String> {
        let control = Control::default();
        let outcome = directories(Source::open(path, None, &control).unwrap());
        std::fs::remove_file(path).unwrap();
        match outcome {
            Err(Problem::Bad(words, _) | Problem::Unsupported(words)) => Some(words),
            Ok(_) => None,
        }
    }

    #[test]
    fn what_exceeds_the_file_is_refused_before_memory_is_taken() {
        // SampleFormat, as many as the decoder's own limit of 256 MiB holds.
        let words = problem(&file("entry", 339, 3, 1 << 23)).unwrap();
        assert!(words.contains("an entry of a page is larger than the file"), "{words}");
        assert_eq!(problem(&file("software", 305, 2, 4)), None);
    }
}
