//! Threads: the only module that names rayon.
//!
//! Work is cut into blocks whose size does not depend on the number of threads, and partial sums
//! are folded in the order of the blocks, so the same bytes come out for any number of workers.

use std::collections::HashMap;
use std::num::NonZeroUsize;
use std::ops;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rayon::prelude::*;

use crate::control::Control;
use crate::error::{Error, Result};

/// Values that a thread writes between two looks at whether to stop.
const FILLED: usize = 1 << 16;

/// How long a thread beside that of a caller stays awake for the next short work. To wake one takes some 50 µs.
const AWAKE: Duration = Duration::from_micros(200);

/// Numbers of single or double precision.
pub(crate) trait Value:
    Copy
    + Default
    + Send
    + Sync
    + ops::Add<Output = Self>
    + ops::Sub<Output = Self>
    + ops::Mul<Output = Self>
    + ops::AddAssign
    + Into<f64>
{
    fn of(value: f64) -> Self;
}

impl Value for f32 {
    #[inline(always)]
    fn of(value: f64) -> Self {
        value as Self
    }
}

impl Value for f64 {
    #[inline(always)]
    fn of(value: f64) -> Self {
        value
    }
}

/// a · b in double precision, in several sums side by side, which vector registers hold.
pub(crate) fn dot<A: Value, B: Value>(a: &[A], b: &[B]) -> f64 {
    pulp::Arch::new().dispatch(Dot(a, b))
}

struct Dot<'s, A, B>(&'s [A], &'s [B]);

impl<A: Value, B: Value> pulp::NullaryFnOnce for Dot<'_, A, B> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        const LANES: usize = 16;
        let ((a, rest_a), (b, rest_b)) = (self.0.as_chunks::<LANES>(), self.1.as_chunks::<LANES>());
        let mut sums = [0.0; LANES];
        for (a, b) in a.iter().zip(b) {
            for i in 0..LANES {
                sums[i] += Into::<f64>::into(a[i]) * b[i].into();
            }
        }
        let rest = rest_a.iter().zip(rest_b).map(|(&a, &b)| Into::<f64>::into(a) * b.into());
        sums.iter().sum::<f64>() + rest.sum::<f64>()
    }
}

/// sums += f · values, in double precision.
pub(crate) struct Add<'s, V, S> {
    pub(crate) factor: f64,
    pub(crate) values: &'s [V],
    pub(crate) sums: &'s mut [S],
}

impl<V: Value, S: Value> Add<'_, V, S> {
    pub(crate) fn dispatch(self) {
        pulp::Arch::new().dispatch(self);
    }
}

impl<V: Value, S: Value> pulp::NullaryFnOnce for Add<'_, V, S> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (sum, &value) in self.sums.iter_mut().zip(self.values) {
            *sum = S::of(Into::<f64>::into(*sum) + self.factor * value.into());
        }
    }
}

/// A pool of worker threads.
#[derive(Clone, Debug)]
pub struct Workers {
    pool: Arc<rayon::ThreadPool>,
    /// Whether a thread of the pool runs [`enter`](Workers::enter).
    entered: Arc<AtomicBool>,
    beside: Arc<Beside>,
}

/// A thread that takes a part of the short works of one caller at a time.
#[derive(Debug, Default)]
struct Beside {
    is_awake: AtomicBool,
    /// The pool of this thread alone, and when the last work ended.
    last: Mutex<Option<(rayon::ThreadPool, Instant)>>,
}

impl Beside {
    /// Lets the thread wait for works without sleep, until none has come for a while.
    fn keep_awake(self: &Arc<Self>, pool: &rayon::ThreadPool) {
        let beside = Arc::clone(self);
        self.is_awake.store(true, Ordering::Release);
        pool.spawn(move || {
            let mut last = Instant::now();
            while last.elapsed() < AWAKE {
                match rayon::yield_now() {
                    Some(rayon::Yield::Executed) => last = Instant::now(),
                    _ => std::hint::spin_loop(),
                }
            }
            beside.is_awake.store(false, Ordering::Release);
        });
    }
}

/// The pools of this process, by process id and number of threads, where one is asked for.
///
/// A forked child inherits the table but not the threads, so the id is part of the key; the
/// parent's pools stay in the child's table untouched, since to drop one would wait for threads
/// that the child does not have.
static POOLS: Mutex<Option<HashMap<Key, Workers>>> = Mutex::new(None);

/// Process id, and number of threads.
type Key = (u32, Option<NonZeroUsize>);

/// Lets the next enter, also after a panic.
struct Leave<'w>(&'w AtomicBool);

impl Drop for Leave<'_> {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

impl Workers {
    /// The pool of `count` threads, started at its first use; `None` means every processor that
    /// this process may run on at the first call. To count them takes as long as to correct a small frame.
    ///
    /// # Errors
    /// [`Error::Workers`] if the threads cannot be started.
    pub fn new(count: Option<NonZeroUsize>) -> Result<Self> {
        let key = |count| (std::process::id(), count);
        let pools = || POOLS.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(workers) = pools().get_or_insert_default().get(&key(count)) {
            return Ok(workers.clone());
        }
        let workers = match count {
            Some(count) => Self::started(count.get())?,
            None => {
                Self::new(Some(std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN)))?
            }
        };
        Ok(pools().get_or_insert_default().entry(key(count)).or_insert(workers).clone())
    }

    fn started(count: usize) -> Result<Self> {
        Ok(Self { pool: Arc::new(pool(count)?), entered: Arc::default(), beside: Arc::default() })
    }

    /// How many threads the pool has.
    #[must_use]
    pub fn count(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Runs `work`, which consists of many short parallel steps, on a thread of the pool. The other threads
    /// then stay awake between two steps; to wake them takes as long as a short step.
    ///
    /// Only one caller at a time. A thread that waits for the end of a step runs other jobs of the pool
    /// meanwhile, and a second long work would delay the first until it has ended: it stays on the thread of its
    /// caller, as does the work of a pool of one thread.
    pub fn enter<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        // The only thread of a pool must stay free for what other callers ask.
        if self.count() == 1 || self.entered.swap(true, Ordering::Acquire) {
            return work();
        }
        let _leave = Leave(&self.entered);
        self.pool.install(work)
    }

    /// Calls `work` for each part on this thread, and also on another one if that is awake: it is while short
    /// works follow one another.
    ///
    /// A thread that sleeps would start when a work of 50 µs is over, so the first of a series of works is
    /// done here alone; so are works of other callers meanwhile.
    pub(crate) fn share<P>(&self, parts: impl Iterator<Item = P> + Send, work: impl Fn(P) + Sync) {
        let parts = Mutex::new(parts);
        let next = || parts.lock().unwrap_or_else(PoisonError::into_inner).next();
        let take = || std::iter::from_fn(next).for_each(&work);
        let beside = &self.beside;
        let Some(mut last) = (self.count() > 1).then(|| beside.last.try_lock().ok()).flatten()
        else {
            return take();
        };
        match &mut *last {
            Some((pool, _)) if beside.is_awake.load(Ordering::Acquire) => {
                pool.in_place_scope(|scope| {
                    scope.spawn(|_| take());
                    take();
                });
            }
            Some((pool, ended)) => {
                if ended.elapsed() < AWAKE {
                    beside.keep_awake(pool);
                }
                take();
            }
            None => take(),
        }
        match &mut *last {
            Some((_, ended)) => *ended = Instant::now(),
            None => *last = pool(1).ok().map(|pool| (pool, Instant::now())),
        }
    }

    /// Does two works, side by side where a thread is free.
    pub(crate) fn both<A: Send, B: Send>(
        &self,
        one: impl FnOnce() -> A + Send,
        other: impl FnOnce() -> B + Send,
    ) -> (A, B) {
        self.pool.install(|| rayon::join(one, other))
    }

    /// Calls `work` for 0, 1, … `count` − 1 in parallel; the results stand in that order.
    pub fn map<R: Send>(&self, count: usize, work: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
        self.pool.install(|| (0..count).into_par_iter().map(work).collect())
    }

    /// Cuts `data` into blocks of `size` and calls `work(index, block)` for each, in parallel;
    /// the results stand in the order of the blocks.
    pub fn map_blocks<T, R>(
        &self,
        data: &mut [T],
        size: usize,
        work: impl Fn(usize, &mut [T]) -> R + Sync + Send,
    ) -> Vec<R>
    where
        T: Send,
        R: Send,
    {
        self.pool.install(|| {
            data.par_chunks_mut(size.max(1))
                .enumerate()
                .map(|(index, block)| work(index, block))
                .collect()
        })
    }

    /// So many of one value, written by the threads that will use them, unless `control` asks to
    /// stop.
    ///
    /// A fresh page costs some microseconds when it is touched for the first time, so that a large
    /// array takes longer than Ctrl-C may; and memory that is only reserved would be mapped twice
    /// where it is read before it is written.
    pub(crate) fn filled<T>(&self, length: usize, value: T, control: &Control) -> Vec<T>
    where
        T: Copy + Default + Send + Sync,
    {
        let mut values = vec![T::default(); length];
        self.fill(&mut values, value, control);
        values
    }

    /// Writes one value everywhere, unless `control` asks to stop.
    pub(crate) fn fill<T>(&self, values: &mut [T], value: T, control: &Control)
    where
        T: Copy + Send + Sync,
    {
        self.map_blocks(values, FILLED, |_, part| {
            if !control.is_cancelled() {
                part.fill(value);
            }
        });
    }

    /// a · b.
    pub(crate) fn dot<A: Value, B: Value>(&self, a: &[A], b: &[B]) -> f64 {
        let blocks: Vec<_> = a.chunks(FILLED).zip(b.chunks(FILLED)).collect();
        let sums = self.map(blocks.len(), |index| {
            let (a, b) = blocks[index];
            dot(a, b)
        });
        sums.into_iter().sum()
    }

    /// y ← y + f x.
    pub(crate) fn add_multiple<Y: Value, X: Value>(&self, y: &mut [Y], factor: f64, x: &[X]) {
        self.map_blocks(y, FILLED, |index, sums| {
            Add { factor, values: &x[index * FILLED..], sums }.dispatch();
        });
    }

    /// Calls `work(index, part)` for each part in parallel; the results stand in the order of the parts.
    pub(crate) fn each<T: Send, R: Send>(
        &self,
        parts: Vec<T>,
        work: impl Fn(usize, T) -> R + Sync + Send,
    ) -> Vec<R> {
        let work = |(index, part)| work(index, part);
        self.pool.install(|| parts.into_par_iter().enumerate().map(work).collect())
    }

    /// Like [`map_blocks`](Self::map_blocks) over two slices at once, cut into as many blocks.
    pub fn map_pairs<A, B, R>(
        &self,
        first: &mut [A],
        second: &mut [B],
        sizes: [usize; 2],
        work: impl Fn(usize, &mut [A], &mut [B]) -> R + Sync + Send,
    ) -> Vec<R>
    where
        A: Send,
        B: Send,
        R: Send,
    {
        let [one, other] = sizes.map(|size| size.max(1));
        self.pool.install(|| {
            let pairs = first.par_chunks_mut(one).zip(second.par_chunks_mut(other));
            pairs.enumerate().map(|(index, (first, second))| work(index, first, second)).collect()
        })
    }
}

/// A pool of rayon's.
fn pool(count: usize) -> Result<rayon::ThreadPool> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(count)
        .thread_name(|index| format!("equipix-{index}"))
        .build();
    pool.map_err(|error| Error::Workers { workers: count, reason: error.to_string() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_inside() -> bool {
        std::thread::current().name().is_some_and(|name| name.starts_with("equipix-"))
    }

    #[test]
    fn one_work_at_a_time_enters_the_pool() {
        let workers = Workers::new(NonZeroUsize::new(5)).unwrap();
        let (seen, other) = workers.enter(|| {
            let elsewhere = std::thread::scope(|scope| {
                scope.spawn(|| workers.enter(|| (is_inside(), workers.map(9, |i| i)))).join()
            });
            (is_inside(), elsewhere.unwrap())
        });
        assert!(seen);
        assert_eq!(other, (false, (0..9).collect()));
    }

    #[test]
    fn a_pool_of_one_thread_stays_free() {
        let workers = Workers::new(NonZeroUsize::new(1)).unwrap();
        assert!(!workers.enter(is_inside));
    }

    #[test]
    fn short_works_that_follow_one_another_take_two_threads() {
        let workers = Workers::new(NonZeroUsize::new(4)).unwrap();
        // Under load the other thread may start late, but not in every of so many works.
        let shared = (0..100_000).any(|_| {
            let [here, there] = [0, 0].map(std::sync::atomic::AtomicUsize::new);
            workers.share(0..64_usize, |part| {
                (0..1000).for_each(|_| std::hint::spin_loop());
                let sum = if is_inside() { &there } else { &here };
                sum.fetch_add(1 << part.min(6), Ordering::Relaxed);
            });
            let [here, there] = [here, there].map(std::sync::atomic::AtomicUsize::into_inner);
            assert_eq!(here + there, 63 + 58 * 64);
            there > 0
        });
        assert!(shared);
    }

    #[test]
    fn works_of_a_pool_of_one_thread_and_of_several_callers_are_done_by_themselves() {
        let one = Workers::new(NonZeroUsize::new(1)).unwrap();
        one.share(0..9, |_| assert!(!is_inside()));
        let several = Workers::new(NonZeroUsize::new(3)).unwrap();
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..100 {
                        let sum = std::sync::atomic::AtomicUsize::new(0);
                        several.share(0..50, |part| {
                            sum.fetch_add(part, Ordering::Relaxed);
                        });
                        assert_eq!(sum.into_inner(), 49 * 25);
                    }
                });
            }
        });
    }

    #[test]
    fn the_next_enters_after_a_panic() {
        let workers = Workers::new(NonZeroUsize::new(6)).unwrap();
        let fails = std::panic::AssertUnwindSafe(|| workers.enter(|| panic!("as the test wants")));
        assert!(std::panic::catch_unwind(fails).is_err());
        assert!(workers.enter(is_inside));
    }
}
