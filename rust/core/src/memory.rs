//! What memory this process may still have, asked of Linux before large work starts.
//!
//! It is the least of
//!
//! | bound | from | less |
//! |---|---|---|
//! | the machine | `MemAvailable` of `/proc/meminfo` | |
//! | each control group above the process | `memory.max` (version 1: `memory.limit_in_bytes`) | its use, page cache apart |
//! | the address space, `RLIMIT_AS` | `/proc/self/limits` | `VmSize` of `/proc/self/status` |
//!
//! (proc(5), cgroups(7) and the kernel's cgroup-v2.rst.) Page cache counts as free, since the kernel
//! gives it up first; swap does not count, since a solver passes over all that it holds again and
//! again. A bound that cannot be read is no bound: on other systems nothing is refused.

use std::fs::read_to_string;
use std::path::Path;

use crate::error::{Error, Result};

/// The files of a control group's memory controller, in one of its two versions.
struct Controller {
    mount: &'static str,
    limit: &'static str,
    used: &'static str,
    /// Prefix of the counts in `memory.stat` that include the groups below.
    totals: &'static str,
}

const VERSION_1: Controller = Controller {
    mount: "/sys/fs/cgroup/memory",
    limit: "memory.limit_in_bytes",
    used: "memory.usage_in_bytes",
    totals: "total_",
};

const VERSION_2: Controller =
    Controller { mount: "/sys/fs/cgroup", limit: "memory.max", used: "memory.current", totals: "" };

/// What allocators may add to the bytes that are asked of them: freed arrays of up to 32 MiB linger in
/// the heap of glibc (mallopt(3), `M_MMAP_THRESHOLD`), and each thread begins a heap of its own.
const LINGERING: u64 = 64 << 20;

/// Refuses work that needs more memory than this process may still have.
///
/// `what` says which work, as the beginning of a sentence. The allocator's share comes on top.
///
/// # Errors
/// [`Error::Memory`] if fewer than `needed` bytes are to be had.
pub fn check(needed: u64, what: impl FnOnce() -> String) -> Result<()> {
    let needed = needed.saturating_add(needed.min(LINGERING));
    let bounds = [
        (machine(), "end other work"),
        (groups(), "raise the memory limit of this container or job"),
        (address_space(), "raise the limit of this process (ulimit -v)"),
    ];
    let bounds = bounds.into_iter().filter_map(|(bytes, remedy)| Some((bytes?, remedy)));
    match bounds.min() {
        Some((available, remedy)) if available < needed => {
            Err(Error::Memory { what: what(), needed, available, remedy })
        }
        _ => Ok(()),
    }
}

fn machine() -> Option<u64> {
    Some(1024 * number(&read_to_string("/proc/meminfo").ok()?, "MemAvailable:")?)
}

fn address_space() -> Option<u64> {
    let limit = number(&read_to_string("/proc/self/limits").ok()?, "Max address space")?;
    let used = 1024 * number(&read_to_string("/proc/self/status").ok()?, "VmSize:")?;
    Some(limit.saturating_sub(used))
}

/// What the control groups that hold this process leave it.
fn groups() -> Option<u64> {
    let memberships = read_to_string("/proc/self/cgroup").ok()?;
    memberships.lines().filter_map(left_to_member).min()
}

/// The least that a group and those above it leave; `membership` is `number:controllers:path`.
fn left_to_member(membership: &str) -> Option<u64> {
    let (controllers, path) = membership.split_once(':')?.1.split_once(':')?;
    let controller = match controllers {
        "" => VERSION_2,
        list if list.split(',').any(|name| name == "memory") => VERSION_1,
        _ => return None,
    };
    // In a container the path may be the host's: of its folders only the mount point is seen then.
    let folders = Path::new(path.trim_start_matches('/')).ancestors();
    folders.filter_map(|folder| left(&controller, &Path::new(controller.mount).join(folder))).min()
}

/// What one group leaves: its limit less its use, of which page cache is given up on demand.
fn left(controller: &Controller, folder: &Path) -> Option<u64> {
    let read = |file| read_to_string(folder.join(file)).ok();
    let limit = number(&read(controller.limit)?, "")?;
    let used = number(&read(controller.used)?, "")?;
    let counts = read("memory.stat")?;
    let cache = |kind| number(&counts, &format!("{}{kind} ", controller.totals)).unwrap_or(0);
    let held = used.saturating_sub(cache("active_file") + cache("inactive_file"));
    Some(limit.saturating_sub(held))
}

/// The whole number that follows `name` at the beginning of a line; none where there is a word.
fn number(table: &str, name: &str) -> Option<u64> {
    let value = table.lines().find_map(|line| line.strip_prefix(name))?;
    value.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::time::Instant;

    use super::*;

    /// What a group leaves whose files hold this.
    fn left_by(controller: &Controller, files: [(&str, &str); 3]) -> Option<u64> {
        let name = format!("equipix-{}-{:?}", std::process::id(), std::thread::current().id());
        let folder = std::env::temp_dir().join(name);
        fs::create_dir_all(&folder).unwrap();
        for (file, content) in files {
            fs::write(folder.join(file), content).unwrap();
        }
        let bytes = left(controller, &folder);
        fs::remove_dir_all(folder).unwrap();
        bytes
    }

    #[test]
    fn what_cannot_be_had_is_refused_with_its_bytes() {
        let error = check(u64::MAX, || "counting".into()).unwrap_err();
        let Error::Memory { needed, available, .. } = error else { panic!("{error}") };
        assert!(needed == u64::MAX && available < needed);
        check(1, || "counting".into()).unwrap();
    }

    #[test]
    fn the_kernel_gives_up_page_cache() {
        let stat = "anon 300\nfile 600\ninactive_file 250\nactive_file 150\n";
        let files = [("memory.max", "1000\n"), ("memory.current", "900\n"), ("memory.stat", stat)];
        assert_eq!(left_by(&VERSION_2, files), Some(1000 - (900 - 400)));
        let stat = "inactive_file 1\nactive_file 2\ntotal_inactive_file 30\ntotal_active_file 40\n";
        let files = [
            ("memory.limit_in_bytes", "1000\n"),
            ("memory.usage_in_bytes", "900\n"),
            ("memory.stat", stat),
        ];
        assert_eq!(left_by(&VERSION_1, files), Some(1000 - (900 - 70)));
    }

    #[test]
    fn a_group_without_limit_is_no_bound() {
        let files = [("memory.max", "max\n"), ("memory.current", "900\n"), ("memory.stat", "")];
        assert_eq!(left_by(&VERSION_2, files), None);
        assert_eq!(left(&VERSION_2, Path::new("/nowhere")), None);
    }

    #[test]
    fn a_word_is_no_number() {
        let limits = "Limit  Soft  Hard  Units\nMax address space   unlimited   unlimited  bytes\n";
        assert_eq!(number(limits, "Max address space"), None);
        assert_eq!(number(&limits.replace("unlimited", "12"), "Max address space"), Some(12));
        assert_eq!(number("VmPeak:  9 kB\nVmSize:\t  7 kB\n", "VmSize:"), Some(7));
    }

    #[test]
    fn a_check_takes_less_than_a_millisecond() {
        let mut seconds: Vec<f64> = (0..101)
            .map(|_| {
                let start = Instant::now();
                check(1, String::new).unwrap();
                start.elapsed().as_secs_f64()
            })
            .collect();
        seconds.sort_by(f64::total_cmp);
        assert!(seconds[50] < 1e-3, "{} s", seconds[50]);
    }
}
