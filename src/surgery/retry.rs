//! System calls that signals interrupt.

use std::io;

/// Repeats a call that a signal interrupted. The standard library repeats reads, writes, opens and syncs of files, but
/// not other calls, which some network file systems interrupt as well.
pub(super) fn retry<T>(mut call: impl FnMut() -> io::Result<T>) -> io::Result<T> {
    loop {
        match call() {
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            other => return other,
        }
    }
}
