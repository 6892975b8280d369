//! Windows of files in memory, on Unix.
//!
//! Reading a mapped page that the file no longer has raises SIGBUS. As in servers that share memory with their clients
//! (`wl_shm_buffer_begin_access` of libwayland, `busfault` of Xorg), a handler puts pages of zeros in place of the window,
//! notes that its read failed, and lets the reader go on; every other SIGBUS goes to the handler that was there before. The
//! read then fails with the error that `read` has for a file that became shorter.
//!
//! This module has the unsafe code for reading: the map, and the handler.

#![allow(unsafe_code, reason = "mapping a file is unsafe because others may change it, and so is handling a signal")]

use std::ffi::c_void;
use std::fs::File;
use std::io::{Error, ErrorKind, Result};
use std::mem::MaybeUninit;
use std::ptr;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use memmap2::{Advice, Mmap, MmapOptions};
use rustix::mm::{MapFlags, ProtFlags, mmap_anonymous};

/// Calls `read` with `len` bytes of the file from `start` on, which are mapped for that time. Called by the readers of
/// contents. The bytes may change during the call if another program writes to the file.
///
/// `None`, and `read` is not called, when the file cannot be mapped: the file system or a limit forbids it, too many windows
/// are open, or another library handles SIGBUS.
///
/// # Errors
/// [`ErrorKind::UnexpectedEof`] when the file has become shorter than the window, and another kind when the system failed to
/// read it. What `read` returned is then dropped.
pub(crate) fn with_window<T>(file: &File, start: u64, len: usize, read: impl FnOnce(&[u8]) -> T) -> Option<Result<T>> {
    if !is_handled() {
        return None;
    }
    // SAFETY: the bytes are only looked at, and no decision about memory depends on them; a page that is gone is replaced by
    // the handler as long as the slot has the window, which is shorter than the map lives.
    let map = unsafe { MmapOptions::new().offset(start).len(len).map(file) }.ok()?;
    let _optional = map.advise(Advice::Sequential);
    let window = Window { slot: Slot::take(&map)?, map };
    let found = read(&window.map);
    let failed = window.slot.failed.load(Ordering::Acquire);
    let end = start.saturating_add(u64::try_from(len).unwrap_or(u64::MAX));
    drop(window);
    Some(match file.metadata() {
        Err(error) => Err(error),
        // Behind the end, the rest of a page is zero and raises nothing.
        Ok(metadata) if metadata.len() < end => Err(ErrorKind::UnexpectedEof.into()),
        Ok(_) if failed => Err(Error::other("the system failed to read a part of it")),
        Ok(_) => Ok(found),
    })
}

/// A map that the handler knows. The fields are dropped in this order.
struct Window {
    slot: SlotGuard,
    map: Mmap,
}

/// One window, as the handler sees it.
struct Slot {
    /// First address; [`FREE`], or [`TAKEN`] while the slot is filled.
    start: AtomicUsize,
    end: AtomicUsize,
    failed: AtomicBool,
}

const FREE: usize = 0;
const TAKEN: usize = 1;

/// One for each thread that reads, on any computer that is known.
static SLOTS: [Slot; 1024] =
    [const { Slot { start: AtomicUsize::new(FREE), end: AtomicUsize::new(0), failed: AtomicBool::new(false) } }; 1024];

impl Slot {
    fn take(map: &Mmap) -> Option<SlotGuard> {
        let free = |slot: &&Slot| slot.start.compare_exchange(FREE, TAKEN, Ordering::AcqRel, Ordering::Relaxed).is_ok();
        let slot = SLOTS.iter().find(free)?;
        let page = rustix::param::page_size();
        let start = map.as_ptr().addr();
        slot.failed.store(false, Ordering::Relaxed);
        slot.end.store(start.saturating_add(map.len()).next_multiple_of(page), Ordering::Relaxed);
        slot.start.store(start.saturating_sub(start.checked_rem(page).unwrap_or(0)), Ordering::Release);
        Some(SlotGuard(slot))
    }
}

/// Frees the slot when it is dropped.
struct SlotGuard(&'static Slot);

impl std::ops::Deref for SlotGuard {
    type Target = Slot;

    fn deref(&self) -> &Slot {
        self.0
    }
}

impl Drop for SlotGuard {
    fn drop(&mut self) {
        self.0.start.store(FREE, Ordering::Release);
    }
}

/// What handled SIGBUS before.
static PREVIOUS: OnceLock<libc::sigaction> = OnceLock::new();

/// Whether [`handle`] gets SIGBUS; the first call installs it. A library that installs its own later keeps it.
fn is_handled() -> bool {
    PREVIOUS.get_or_init(|| {
        let previous = current();
        // SAFETY: zeros are a valid sigaction, whose mask is empty, and the handler has the signature of SA_SIGINFO.
        unsafe {
            let mut action: libc::sigaction = MaybeUninit::zeroed().assume_init();
            action.sa_sigaction = handler_address();
            action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
            libc::sigaction(libc::SIGBUS, &raw const action, ptr::null_mut());
        }
        previous
    });
    current().sa_sigaction == handler_address()
}

fn handler_address() -> usize {
    let handler: extern "C" fn(i32, *mut libc::siginfo_t, *mut c_void) = handle;
    handler as usize
}

/// What handles SIGBUS now.
fn current() -> libc::sigaction {
    // SAFETY: zeros are a valid sigaction, and the call only writes to it.
    unsafe {
        let mut action: libc::sigaction = MaybeUninit::zeroed().assume_init();
        libc::sigaction(libc::SIGBUS, ptr::null(), &raw mut action);
        action
    }
}

/// Handles SIGBUS. Everything it calls may be called in a handler: loads and stores of atomics, and system calls.
extern "C" fn handle(signal: i32, info: *mut libc::siginfo_t, context: *mut c_void) {
    // SAFETY: the system passes a valid pointer for SA_SIGINFO; `si_addr` is set for a SIGBUS that it raises itself.
    let (address, is_fault) = unsafe { ((*info).si_addr().addr(), (*info).si_code > 0) };
    for slot in &SLOTS {
        let start = slot.start.load(Ordering::Acquire);
        let end = slot.end.load(Ordering::Relaxed);
        if is_fault && start > TAKEN && (start..end).contains(&address) {
            slot.failed.store(true, Ordering::Release);
            let flags = MapFlags::PRIVATE | MapFlags::FIXED;
            // SAFETY: the range is that of a map whose reader is this thread, interrupted here.
            let zeros = unsafe {
                mmap_anonymous(ptr::without_provenance_mut(start), end.wrapping_sub(start), ProtFlags::READ, flags)
            };
            if zeros.is_ok() {
                return;
            }
        }
    }
    pass_on(signal, info, context);
}

/// Does what would have been done without [`handle`].
fn pass_on(signal: i32, info: *mut libc::siginfo_t, context: *mut c_void) {
    let previous = PREVIOUS.get().map_or((libc::SIG_DFL, 0), |action| (action.sa_sigaction, action.sa_flags));
    match previous {
        (libc::SIG_DFL | libc::SIG_IGN, _) => {
            // SAFETY: zeros are the default action. The signal that is raised arrives when this handler returns.
            unsafe {
                let action: libc::sigaction = MaybeUninit::zeroed().assume_init();
                libc::sigaction(signal, &raw const action, ptr::null_mut());
                libc::raise(signal);
            }
        }
        (handler, flags) if flags & libc::SA_SIGINFO != 0 => {
            // SAFETY: the flag states the signature.
            let handler: extern "C" fn(i32, *mut libc::siginfo_t, *mut c_void) =
                unsafe { std::mem::transmute(handler) };
            handler(signal, info, context);
        }
        (handler, _) => {
            // SAFETY: without the flag, a handler has one argument.
            let handler: extern "C" fn(i32) = unsafe { std::mem::transmute(handler) };
            handler(signal);
        }
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    use std::fs;
    use std::os::unix::process::ExitStatusExt as _;
    use std::process::Command;

    use super::*;

    const LEN: usize = 1 << 20;

    fn file(dir: &tempfile::TempDir) -> File {
        let path = dir.path().join("file");
        fs::write(&path, vec![1; LEN]).unwrap();
        fs::OpenOptions::new().read(true).write(true).open(path).unwrap()
    }

    fn sum(bytes: &[u8]) -> u64 {
        bytes.iter().map(|byte| u64::from(*byte)).sum()
    }

    #[test]
    fn a_window_has_the_bytes_of_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let file = file(&dir);
        assert_eq!(with_window(&file, 77, 1000, sum).unwrap().unwrap(), 1000);
    }

    #[test]
    fn a_file_that_is_cut_off_fails_without_a_signal() {
        let dir = tempfile::tempdir().unwrap();
        for left in [0, 1, 100_000, LEN as u64 - 1] {
            let file = file(&dir);
            let cut = |bytes: &[u8]| {
                file.set_len(left).unwrap();
                sum(bytes)
            };
            let read = with_window(&file, 4096, LEN - 4096, cut).unwrap();
            assert_eq!(read.unwrap_err().kind(), ErrorKind::UnexpectedEof, "{left} bytes left");
        }
        let file = file(&dir);
        assert_eq!(with_window(&file, 0, LEN, sum).unwrap().unwrap(), LEN as u64, "the next window");
    }

    #[test]
    fn many_threads_have_windows_of_their_own() {
        std::thread::scope(|scope| {
            for n in 0..16_u64 {
                scope.spawn(move || {
                    let dir = tempfile::tempdir().unwrap();
                    let file = file(&dir);
                    for _ in 0..20 {
                        let cut = |bytes: &[u8]| {
                            if n % 2 == 0 {
                                file.set_len(n).unwrap();
                            }
                            sum(bytes)
                        };
                        assert_eq!(with_window(&file, 0, LEN, cut).unwrap().ok(), (n % 2 == 1).then_some(LEN as u64));
                        file.set_len(LEN as u64).unwrap();
                    }
                });
            }
        });
    }

    /// A map that the handler does not know still ends the process; run by the test below.
    #[test]
    #[ignore = "ends the process"]
    fn another_map() {
        let dir = tempfile::tempdir().unwrap();
        let file = file(&dir);
        assert_eq!(with_window(&file, 0, LEN, sum).unwrap().unwrap(), LEN as u64);
        // SAFETY: this is what the test is about.
        let map = unsafe { Mmap::map(&file) }.unwrap();
        file.set_len(0).unwrap();
        sum(&map);
    }

    #[test]
    fn other_faults_end_the_process() {
        let name = concat!(module_path!(), "::another_map").split_once("::").unwrap().1;
        let mut run = Command::new(std::env::current_exe().unwrap());
        let run = run.args(["--exact", name, "--ignored"]).output().unwrap();
        assert_eq!(run.status.signal(), Some(libc::SIGBUS), "{}", String::from_utf8_lossy(&run.stdout));
    }
}
