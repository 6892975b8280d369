//! Work on several threads.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::thread;

/// Maximum number of threads: more do not make storage faster, and each has its buffers.
const THREADS: usize = 16;

/// Stack of each thread: as much as the main thread usually has, of which data of limited depth needs a quarter.
const STACK: usize = 8 << 20;

/// Number of threads for reading, hashing and writing tensors: one for each processor that this process may use.
///
/// The system is asked once: that reads files of the control groups.
pub(crate) fn threads() -> usize {
    static COUNT: OnceLock<usize> = OnceLock::new();
    *COUNT.get_or_init(|| thread::available_parallelism().map_or(1, usize::from).min(THREADS))
}

/// Applies `work` to every item, on at most `threads` threads, which take the items in order; returns the results in the
/// order of the items. Each thread makes one `state`, such as its buffers, and reuses it.
///
/// With one thread or one item, everything runs on the calling thread.
pub(crate) fn map<T: Sync, S, R: Send>(
    threads: usize,
    items: &[T],
    state: impl Fn() -> S + Sync,
    work: impl Fn(&mut S, &T) -> R + Sync,
) -> Vec<R> {
    let next = AtomicUsize::new(0);
    let results = Mutex::new(Vec::with_capacity(items.len()));
    let run = || {
        let mut own = state();
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            let Some(item) = items.get(index) else { break };
            let result = work(&mut own, item);
            results.lock().unwrap_or_else(PoisonError::into_inner).push((index, result));
        }
    };
    thread::scope(|scope| {
        for _ in 1..threads.min(items.len()) {
            // Without another thread, this one does all of the work.
            let _started = thread::Builder::new().stack_size(STACK).spawn_scoped(scope, run);
        }
        run();
    });
    let mut results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    results.sort_unstable_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use super::map;

    #[test]
    fn results_have_the_order_of_the_items() {
        let items: Vec<usize> = (0..1000).collect();
        for threads in [0, 1, 3, 2000] {
            assert_eq!(map(threads, &items, || (), |(), n| n * 2), items.iter().map(|n| n * 2).collect::<Vec<_>>());
        }
        assert!(map(4, &[], || (), |(), n: &usize| *n).is_empty());
    }
}
