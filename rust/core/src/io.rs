//! Frames from image files: grey TIFF (every page), PNG, PGM and BMP, of 8 or 16 bits.
//!
//! The only module that names the crates `image` and `tiff`. Files are decoded in parallel, a
//! batch at a time, so memory does not grow with their number; a page is decoded whole or the
//! whole job fails, and none is passed over. The numbers are those in the file: nothing is
//! scaled, inverted or converted.

mod bitmap;
mod source;
mod tiff;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use ::tiff::decoder::DecodingBuffer;

use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Shape, Stack};
use crate::memory;
use crate::parallel::Workers;
use crate::statistics::{Accumulator, Statistics, Summable};
use source::{MAX_COMPRESSION, Source};

/// Frames of one batch: enough for the workers and the sums, few enough to stay small.
const BATCH: usize = 16;

/// Bytes of one batch, unless every worker's one frame takes more.
const BATCH_BYTES: usize = 1 << 26;

/// The frames of one file.
#[derive(Clone, Debug)]
pub struct Frames<T> {
    /// How many.
    pub count: usize,
    /// Sizes of each.
    pub shape: Shape,
    /// One behind the other, row by row.
    pub data: Vec<T>,
}

/// The frames of one file, in the file's own sample type.
#[derive(Clone, Debug)]
pub enum AnyFrames {
    /// 8 bits.
    U8(Frames<u8>),
    /// 16 bits.
    U16(Frames<u16>),
}

/// Mean and variance of all pages of all files.
///
/// `saturation` is as in [`Accumulator::new`], `mask` as in [`Accumulator::masked`]. Progress counts pages, in the stage "average".
///
/// # Errors
/// [`Error::File`] or [`Error::Unsupported`] for the first file, in the order given, that is not
/// a whole grey image of the shape and depth of the first; [`Error::Value`] if there is no file;
/// [`Error::Memory`] if there is no room.
pub fn average(
    paths: &[PathBuf],
    saturation: Option<f64>,
    mask: Option<&[bool]>,
    workers: &Workers,
    control: &Control,
) -> Result<Statistics> {
    let first = paths.first().ok_or_else(|| Error::value("source", "names no file"))?;
    let format = format(first, control)?;
    match format.depth {
        Depth::Eight => average_as::<u8>(paths, format, saturation, mask, workers, control),
        Depth::Sixteen => average_as::<u16>(paths, format, saturation, mask, workers, control),
    }
}

/// All pages of one file.
///
/// # Errors
/// [`Error::File`], [`Error::Unsupported`] or [`Error::Memory`], as in [`average`].
pub fn read(path: &Path, workers: &Workers, control: &Control) -> Result<AnyFrames> {
    let format = format(path, control)?;
    Ok(match format.depth {
        Depth::Eight => AnyFrames::U8(read_as(path, format, workers, control)?),
        Depth::Sixteen => AnyFrames::U16(read_as(path, format, workers, control)?),
    })
}

/// Number of pages of a file, and sizes and bits per sample of the first; none is decoded.
///
/// # Errors
/// [`Error::File`] or [`Error::Unsupported`], as in [`average`].
pub fn describe(path: &Path, control: &Control) -> Result<(usize, Shape, u32)> {
    let Format { shape, depth } = format(path, control)?;
    let bits = if depth == Depth::Eight { 8 } else { 16 };
    Ok((pages(path, control)?.len(), shape, bits))
}

/// Exposure time in s of a TIFF file, where a tag of its first page or its EXIF holds one.
///
/// # Errors
/// [`Error::File`] or [`Error::Unsupported`], as in [`average`].
pub fn exposure_s(path: &Path, control: &Control) -> Result<Option<f64>> {
    guarded(path, control, || tiff::exposure_s(Source::open(path, None, control)?))
}

/// What all frames of a job have in common.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Format {
    shape: Shape,
    depth: Depth,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Depth {
    Eight,
    Sixteen,
}

impl Format {
    const fn bytes(self) -> usize {
        self.shape.len().saturating_mul(match self.depth {
            Depth::Eight => 1,
            Depth::Sixteen => 2,
        })
    }
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let bits = if self.depth == Depth::Eight { 8 } else { 16 };
        write!(f, "{} x {} (rows x columns), {bits} bits", self.shape.rows, self.shape.cols)
    }
}

/// Why a page cannot be had.
enum Problem {
    /// It is broken, or not what was wanted.
    Bad(String, Option<Box<dyn std::error::Error + Send + Sync>>),
    /// Another reader may be able to.
    Unsupported(String),
}

type Outcome<T> = std::result::Result<T, Problem>;

impl Problem {
    fn bad(what: impl Into<String>) -> Self {
        Self::Bad(what.into(), None)
    }

    fn at(self, path: &Path) -> Error {
        let path = path.to_path_buf();
        match self {
            Self::Bad(problem, source) => Error::File { path, problem, source },
            Self::Unsupported(feature) => Error::Unsupported { path, feature },
        }
    }
}

impl From<std::io::Error> for Problem {
    fn from(error: std::io::Error) -> Self {
        let what = match error.kind() {
            std::io::ErrorKind::UnexpectedEof => "is truncated".into(),
            std::io::ErrorKind::NotFound => "does not exist".into(),
            _ => format!("cannot be read: {error}"),
        };
        Self::Bad(what, Some(error.into()))
    }
}

/// A page, opened and described, about to be decoded.
trait Picture {
    fn format(&self) -> Format;
    fn decode(self: Box<Self>, bytes: &mut [u8]) -> Outcome<()>;
}

/// A sample that files hold.
trait FileSample: Summable + Default {
    /// The buffer in the form that gives access to its bytes.
    fn buffer(samples: &mut [Self]) -> DecodingBuffer<'_>;
}

impl FileSample for u8 {
    fn buffer(samples: &mut [Self]) -> DecodingBuffer<'_> {
        DecodingBuffer::U8(samples)
    }
}

impl FileSample for u16 {
    fn buffer(samples: &mut [Self]) -> DecodingBuffer<'_> {
        DecodingBuffer::U16(samples)
    }
}

/// Where a page is: in a TIFF its directory's offset says so.
#[derive(Clone, Copy, Debug)]
struct Page<'a> {
    path: &'a Path,
    number: usize,
    directory: Option<u32>,
}

impl<'a> Page<'a> {
    const fn first(path: &'a Path) -> Self {
        Self { path, number: 0, directory: None }
    }

    fn open<'c>(&self, control: &'c Control) -> Outcome<Box<dyn Picture + 'c>> {
        let source = Source::open(self.path, self.directory, control)?;
        let length = source.length();
        if length == 0 {
            return Err(Problem::bad("is empty"));
        }
        let kind = kind(self.path)?;
        let picture: Box<dyn Picture> = match kind {
            Kind::Tiff => Box::new(tiff::Picture::new(source)?),
            Kind::Png => Box::new(bitmap::Png::new(source)?),
            Kind::Pgm => Box::new(bitmap::Pgm::new(source)?),
            Kind::Bmp => Box::new(bitmap::Bmp::new(source)?),
        };
        let format = picture.format();
        if format.shape.is_empty() {
            return Err(Problem::bad("has no pixels"));
        }
        let packing = if matches!(kind, Kind::Pgm | Kind::Bmp) { 1 } else { MAX_COMPRESSION };
        if format.bytes() / packing > length {
            return Err(Problem::bad(format!("claims {format} in a file of {length} bytes")));
        }
        Ok(picture)
    }

    /// Decodes into `samples`, or says what differs from `wanted`, the format of `like`.
    fn load<T: FileSample>(
        &self,
        wanted: Format,
        like: &Path,
        samples: &mut [T],
        control: &Control,
    ) -> Result<()> {
        guarded(self.path, control, || {
            let picture = self.open(control)?;
            let format = picture.format();
            if format != wanted {
                return Err(Problem::bad(format!(
                    "page {} is {format}, expected {wanted} as in {}",
                    self.number,
                    like.display()
                )));
            }
            picture.decode(T::buffer(samples).as_bytes_mut())
        })
    }
}

enum Kind {
    Tiff,
    Png,
    Pgm,
    Bmp,
}

fn kind(path: &Path) -> Outcome<Kind> {
    let suffix = path.extension().map(|suffix| suffix.to_string_lossy().to_ascii_lowercase());
    match suffix.as_deref() {
        Some("tif" | "tiff") => Ok(Kind::Tiff),
        Some("png") => Ok(Kind::Png),
        Some("pgm") => Ok(Kind::Pgm),
        Some("bmp") => Ok(Kind::Bmp),
        _ => Err(Problem::bad("has no suffix of an image, expected .tif, .tiff, .png, .pgm, .bmp")),
    }
}

/// Runs a decoder, which may panic on hostile input, and says which file was at fault.
fn guarded<R>(path: &Path, control: &Control, work: impl FnOnce() -> Outcome<R>) -> Result<R> {
    control.check()?;
    let outcome = catch_unwind(AssertUnwindSafe(work))
        .unwrap_or_else(|_| Err(Problem::bad("is broken: the decoder gave up")));
    outcome.map_err(|problem| control.check().err().unwrap_or_else(|| problem.at(path)))
}

fn format(path: &Path, control: &Control) -> Result<Format> {
    guarded(path, control, || Ok(Page::first(path).open(control)?.format()))
}

/// The pages of a file, in its own order.
fn pages<'a>(path: &'a Path, control: &Control) -> Result<Vec<Page<'a>>> {
    guarded(path, control, || {
        let Kind::Tiff = kind(path)? else { return Ok(vec![Page::first(path)]) };
        let directories = tiff::directories(Source::open(path, None, control)?)?;
        let page = |(number, offset)| Page { path, number, directory: Some(offset) };
        Ok(directories.into_iter().enumerate().map(page).collect())
    })
}

fn average_as<T: FileSample>(
    paths: &[PathBuf],
    format: Format,
    saturation: Option<f64>,
    mask: Option<&[bool]>,
    workers: &Workers,
    control: &Control,
) -> Result<Statistics> {
    let size = (BATCH_BYTES / format.bytes()).clamp(workers.count().min(BATCH), BATCH);
    let bytes = size.saturating_mul(format.bytes()) as u64;
    let bytes = bytes.saturating_add(Accumulator::<T>::bytes(format.shape));
    memory::check(bytes, || format!("averaging frames of {}", format.shape))?;
    let mut buffer = vec![T::default(); size * format.shape.len()];
    let mut sums = Accumulator::<T>::new(format.shape, saturation)?;
    if let Some(mask) = mask {
        sums = sums.masked(mask)?;
    }
    let (mut done, mut total) = (0, paths.len());
    for files in paths.chunks(size) {
        let found = workers.map(files.len(), |index| pages(&files[index], control));
        let found = found.into_iter().collect::<Result<Vec<_>>>()?.concat();
        total += found.len() - files.len();
        for batch in found.chunks(size) {
            let samples = &mut buffer[..batch.len() * format.shape.len()];
            load(batch, format, &paths[0], samples, workers, control)?;
            sums.add(&Stack::new("source", samples, batch.len(), format.shape)?, workers, control)?;
            done += batch.len();
            control.report("average", done as u64, total as u64);
        }
    }
    Ok(sums.finish())
}

fn read_as<T: FileSample>(
    path: &Path,
    format: Format,
    workers: &Workers,
    control: &Control,
) -> Result<Frames<T>> {
    let pages = pages(path, control)?;
    let bytes = pages.len().saturating_mul(format.bytes());
    memory::check(bytes as u64, || format!("reading {}", path.display()))?;
    let mut data = vec![T::default(); pages.len() * format.shape.len()];
    load(&pages, format, path, &mut data, workers, control)?;
    Ok(Frames { count: pages.len(), shape: format.shape, data })
}

/// Decodes pages into `samples`, one behind the other; of several errors the first page's counts.
fn load<T: FileSample>(
    pages: &[Page],
    format: Format,
    like: &Path,
    samples: &mut [T],
    workers: &Workers,
    control: &Control,
) -> Result<()> {
    let outcomes = workers.map_blocks(samples, format.shape.len(), |index, frame| {
        pages[index].load(format, like, frame, control)
    });
    outcomes.into_iter().collect()
}
