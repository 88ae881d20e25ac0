//! Files of one image: PNG, PGM and BMP.
//!
//! The `image` crate stretches samples of other depths than 8 and 16 bits to these; here the
//! numbers in the file count, so such files are refused or read without its help.

use std::io::{BufRead, BufReader, Read, Seek};

use image::codecs::bmp::BmpDecoder;
use image::codecs::png::PngDecoder;
use image::codecs::pnm::{PnmDecoder, PnmSubtype, SampleEncoding};
use image::{ColorType, ImageDecoder, ImageError, Limits};

use super::source::Source;
use super::{Depth, Format, Outcome, Picture, Problem};
use crate::frames::Shape;

type Reader<'c> = BufReader<Source<'c>>;

impl From<ImageError> for Problem {
    fn from(error: ImageError) -> Self {
        match error {
            ImageError::IoError(error) => error.into(),
            _ => Self::Bad(format!("is not a readable image: {error}"), Some(error.into())),
        }
    }
}

fn format(decoder: &impl ImageDecoder) -> Outcome<Format> {
    let (cols, rows) = decoder.dimensions();
    let depth = match decoder.color_type() {
        ColorType::L8 => Depth::Eight,
        ColorType::L16 => Depth::Sixteen,
        other => return Err(Problem::bad(format!("is {other:?}, expected one grey channel"))),
    };
    Ok(Format { shape: Shape::new(rows as usize, cols as usize), depth })
}

/// The first bytes of a file, which is then read from the start again.
fn head<const N: usize>(reader: &mut Reader) -> Outcome<[u8; N]> {
    let mut bytes = [0; N];
    reader.read_exact(&mut bytes)?;
    reader.rewind()?;
    Ok(bytes)
}

/// A PNG file.
pub(super) struct Png<'c> {
    decoder: PngDecoder<Reader<'c>>,
    format: Format,
}

impl<'c> Png<'c> {
    pub(super) fn new(source: Source<'c>) -> Outcome<Self> {
        let mut reader = BufReader::new(source);
        let head = head::<26>(&mut reader)?;
        let decoder = PngDecoder::with_limits(reader, Limits::default())?;
        // Bytes 24 and 25, in the first chunk: bits per sample and colour type, 0 for grey.
        match (head[24], head[25]) {
            (8 | 16, 0) => {}
            (bits, 0) => return Err(Problem::bad(format!("has {bits} bits, expected 8 or 16"))),
            _ => return Err(Problem::bad("has colours or a palette, expected one grey channel")),
        }
        if decoder.is_apng()? {
            return Err(Problem::bad("is an animation, expected a single image"));
        }
        Ok(Self { format: format(&decoder)?, decoder })
    }
}

impl Picture for Png<'_> {
    fn format(&self) -> Format {
        self.format
    }

    fn decode(self: Box<Self>, bytes: &mut [u8]) -> Outcome<()> {
        Ok(self.decoder.read_image(bytes)?)
    }
}

/// A PGM file, plain or raw; its header is left to the `image` crate.
pub(super) struct Pgm<'c> {
    reader: Reader<'c>,
    format: Format,
    encoding: SampleEncoding,
}

impl<'c> Pgm<'c> {
    pub(super) fn new(source: Source<'c>) -> Outcome<Self> {
        let decoder = PnmDecoder::new(BufReader::new(source))?;
        let PnmSubtype::Graymap(encoding) = decoder.subtype() else {
            return Err(Problem::bad("is no grey map, expected a PGM file of type P2 or P5"));
        };
        let format = format(&decoder)?;
        Ok(Self { reader: decoder.into_inner().0, format, encoding })
    }

    fn decode_raw(&mut self, bytes: &mut [u8]) -> Outcome<()> {
        self.reader.read_exact(bytes)?;
        if self.format.depth == Depth::Sixteen {
            for sample in bytes.chunks_exact_mut(2) {
                let value = u16::from_be_bytes([sample[0], sample[1]]);
                sample.copy_from_slice(&value.to_ne_bytes());
            }
        }
        Ok(())
    }

    fn decode_plain(&mut self, bytes: &mut [u8]) -> Outcome<()> {
        let size = bytes.len() / self.format.shape.len();
        let number = || Problem::bad("holds something else than whole numbers up to 65535");
        for sample in bytes.chunks_exact_mut(size) {
            let value: u16 = word(&mut self.reader)?.parse().map_err(|_| number())?;
            match size {
                1 => sample[0] = u8::try_from(value).map_err(|_| number())?,
                _ => sample.copy_from_slice(&value.to_ne_bytes()),
            }
        }
        Ok(())
    }
}

impl Picture for Pgm<'_> {
    fn format(&self) -> Format {
        self.format
    }

    fn decode(mut self: Box<Self>, bytes: &mut [u8]) -> Outcome<()> {
        match self.encoding {
            SampleEncoding::Binary => self.decode_raw(bytes)?,
            SampleEncoding::Ascii => self.decode_plain(bytes)?,
        }
        skip_space(&mut self.reader)?;
        if self.reader.fill_buf()?.is_empty() {
            return Ok(());
        }
        Err(Problem::bad("goes on after its image, expected a single image"))
    }
}

/// The next number of a plain PGM file; its end is an error.
fn word(reader: &mut impl BufRead) -> Outcome<String> {
    skip_space(reader)?;
    let mut digits = String::new();
    while let Some(&byte) = reader.fill_buf()?.first().filter(|byte| byte.is_ascii_digit()) {
        digits.push(char::from(byte));
        reader.consume(1);
    }
    if reader.fill_buf()?.is_empty() && digits.is_empty() {
        return Err(Problem::bad("is truncated"));
    }
    Ok(digits)
}

fn skip_space(reader: &mut impl BufRead) -> Outcome<()> {
    while reader.fill_buf()?.first().is_some_and(u8::is_ascii_whitespace) {
        reader.consume(1);
    }
    Ok(())
}

/// A BMP file.
pub(super) struct Bmp<'c> {
    decoder: BmpDecoder<Reader<'c>>,
    format: Format,
}

impl<'c> Bmp<'c> {
    pub(super) fn new(source: Source<'c>) -> Outcome<Self> {
        let mut reader = BufReader::new(source);
        let head = head::<34>(&mut reader)?;
        let mut decoder = BmpDecoder::new(reader)?;
        // Bytes 14, 28 and 30: size of the header, bits per pixel, kind of compression.
        if head[14] < 40 || head[28..34] != [8, 0, 0, 0, 0, 0] {
            return Err(Problem::bad("is no uncompressed BMP file of 8 bits, as was expected"));
        }
        let grey =
            |(level, colour): (usize, &[u8; 3])| colour.iter().all(|&c| usize::from(c) == level);
        if !decoder.get_palette().is_some_and(|palette| palette.iter().enumerate().all(grey)) {
            return Err(Problem::bad("has a palette of colours, expected the 256 greys in order"));
        }
        decoder.set_indexed_color(true);
        Ok(Self { format: format(&decoder)?, decoder })
    }
}

impl Picture for Bmp<'_> {
    fn format(&self) -> Format {
        self.format
    }

    fn decode(self: Box<Self>, bytes: &mut [u8]) -> Outcome<()> {
        Ok(self.decoder.read_image(bytes)?)
    }
}
