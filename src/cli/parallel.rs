//! Work on all cores.

use std::sync::{Mutex, PoisonError};
use std::thread;

/// Stack of each thread: as much as the main thread usually has, of which data of limited depth needs a quarter.
const STACK: usize = 8 << 20;

/// What `work` makes of each item, in the order of the items. The first thread without work takes the next item; without
/// other threads, this one does all of it.
///
/// # Panics
/// When `work` panics.
pub fn in_order<T: Send, R: Send>(items: Vec<T>, work: impl Fn(T) -> R + Sync) -> Vec<R> {
    let threads = thread::available_parallelism().map_or(1, usize::from).min(items.len());
    if threads < 2 {
        return items.into_iter().map(work).collect();
    }
    let mut results: Vec<Option<R>> = items.iter().map(|_| None).collect();
    let queue = Mutex::new(items.into_iter().zip(&mut results));
    let run = || {
        let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
        while let Some((item, result)) = next() {
            *result = Some(work(item));
        }
    };
    thread::scope(|scope| {
        for _ in 1..threads {
            let _started = thread::Builder::new().stack_size(STACK).spawn_scoped(scope, run);
        }
        run();
    });
    drop(queue);
    results.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::in_order;

    #[test]
    fn results_are_in_the_order_of_the_items() {
        for count in [0, 1, 2, 1000] {
            let squares = in_order((0..count).collect(), |n: u64| n * n);
            assert_eq!(squares, (0..count).map(|n| n * n).collect::<Vec<_>>());
        }
    }
}
