//! Room on the stack, whatever `ulimit -s` allows.

use super::system;

/// Stack that the deepest data needs, several times over: documents, modules and expressions are limited in depth.
const ENOUGH: u64 = 2 << 20;
/// Stack of the thread that replaces a main thread with less. It is reserved, and used only as far as it is needed.
const RESERVED: usize = 16 << 20;

/// Runs `work` on the main thread, or on a thread of its own where the stack of the main thread is small. Called by
/// [`super::main`] with the whole program.
pub(super) fn with_room<T: Send>(work: impl Fn() -> T + Send + Sync) -> T {
    if system::stack().is_none_or(|limit| limit >= ENOUGH) {
        return work();
    }
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().stack_size(RESERVED).spawn_scoped(scope, &work);
        match thread.map(std::thread::ScopedJoinHandle::join) {
            Ok(Ok(result)) => result,
            Ok(Err(panic)) => std::panic::resume_unwind(panic),
            // Without memory for another stack, the small one may do.
            Err(_) => work(),
        }
    })
}
