//! What the command line asks the system, on Unix; `system_windows.rs` takes its place on Windows.

use std::os::fd::AsFd;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::process::{Pid, Resource, Rlimit, Signal, getrlimit, kill_process, setrlimit};
use rustix::time::{ClockId, clock_gettime};

/// Width of the terminal at standard output, in columns; `None` when it does not tell.
pub fn columns() -> Option<usize> {
    let size = rustix::termios::tcgetwinsize(std::io::stdout()).ok()?;
    (size.ws_col > 0).then_some(usize::from(size.ws_col))
}

/// Whether the terminal at standard output shows colours.
pub const fn shows_color() -> bool {
    true
}

/// Bytes of the stack of the main thread; `None` without a limit.
pub fn stack() -> Option<u64> {
    getrlimit(Resource::Stack).current
}

/// The file of this program, to start it again: also after another one took its name.
pub fn program() -> std::io::Result<PathBuf> {
    let running = Path::new("/proc/self/exe");
    if running.exists() { Ok(running.to_owned()) } else { std::env::current_exe() }
}

/// Limits this process to `seconds` of a processor and `memory` bytes of address space, and forbids core files.
pub fn limit(seconds: u64, memory: u64) -> std::io::Result<()> {
    for (resource, most) in [(Resource::Core, 0), (Resource::Cpu, seconds), (Resource::As, memory)] {
        let given = getrlimit(resource);
        let most = given.current.into_iter().chain(given.maximum).fold(most, u64::min);
        setrlimit(resource, Rlimit { current: Some(most), maximum: Some(most) })?;
    }
    Ok(())
}

/// Time of a processor that this process has taken.
pub fn taken() -> Option<Duration> {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Some(Duration::new(u64::try_from(time.tv_sec).ok()?, u32::try_from(time.tv_nsec).ok()?))
}

/// Sends a signal to a child, which may have ended.
pub fn send(child: &Child, signal: i32) {
    let pid = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
    let _sent = pid.zip(Signal::from_named_raw(signal)).map(|(pid, signal)| kill_process(pid, signal));
}

/// Whether reading would not block, after waiting for at most `time`. A signal ends the wait.
pub fn is_readable(pipe: impl AsFd, time: Duration) -> std::io::Result<bool> {
    let time = Timespec { tv_sec: 0, tv_nsec: time.subsec_nanos().into() };
    match poll(&mut [PollFd::new(&pipe, PollFlags::IN)], Some(&time)) {
        Ok(ready) => Ok(ready > 0),
        Err(Errno::INTR) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// What ended a process: `SIGKILL`, with what sends it unasked, or `exit code 101`.
pub fn ended(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(4), _) => "SIGILL".to_owned(),
        (Some(6), _) => "SIGABRT".to_owned(),
        (Some(7), _) if cfg!(target_os = "linux") => "SIGBUS".to_owned(),
        (Some(9), _) => "SIGKILL, which the kernel sends when memory or time runs out".to_owned(),
        (Some(11), _) => "SIGSEGV".to_owned(),
        (Some(15), _) => "SIGTERM".to_owned(),
        (Some(24), _) => "SIGXCPU".to_owned(),
        (Some(other), _) => format!("signal {other}"),
        (None, code) => format!("exit code {}", code.unwrap_or_default()),
    }
}
