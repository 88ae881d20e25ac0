//! Reads a file of random bytes as the library does; panics, and memory beyond what a file's header
//! claims, end the process.

use std::alloc::System;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::sync::LazyLock;

use cap::Cap;
use equipix_core::control::Control;
use equipix_core::io;
use equipix_core::parallel::Workers;

#[global_allocator]
static MEMORY: Cap<System> = Cap::new(System, usize::MAX);

/// Bytes that a reader may take for any file: buffers, and tables of decoders.
const FIXED: usize = 1 << 20;

/// Bytes that a reader may take for a byte of a file: a value of a TIFF directory takes 32.
const FOR_A_BYTE: usize = 64;

/// Most bytes of pixels that are decoded.
const DECODED: usize = 1 << 22;

static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| {
    let folder = std::env::temp_dir().join(format!("equipix-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("no folder for files");
    folder
});

static WORKERS: LazyLock<Workers> =
    LazyLock::new(|| Workers::new(Some(NonZeroUsize::MIN)).expect("no thread"));

/// Describes and reads `data` as a file of this suffix.
pub fn read(suffix: &str, data: &[u8]) {
    let path = FOLDER.join(format!("file.{suffix}"));
    std::fs::write(&path, data).expect("no space for a file");
    let (control, workers) = (Control::default(), &*WORKERS);
    let small = FIXED + FOR_A_BYTE * data.len();
    let _ = within(small, || io::exposure_s(&path, &control));
    let Ok((count, shape, bits)) = within(small, || io::describe(&path, &control)) else { return };
    let claimed = count * shape.len() * bits as usize / 8;
    if claimed <= DECODED {
        let _ = within(small + claimed, || io::read(&path, workers, &control));
    }
}

/// Works with so many bytes more than are taken already; a request beyond them aborts.
fn within<R>(bytes: usize, work: impl FnOnce() -> R) -> R {
    MEMORY.set_limit(MEMORY.allocated() + bytes).expect("more is taken already");
    let result = work();
    MEMORY.set_limit(usize::MAX).expect("there is no limit");
    result
}
