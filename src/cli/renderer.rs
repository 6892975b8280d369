//! Chat templates in a process of their own: the program, started again with [`ARGUMENT`], which first limits itself.

use std::io::{Read as _, Write as _};
use std::process::{Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use super::exit::{CLEAN, FAILED};
use super::system;
use crate::check::{RenderJob, Rendering};

/// The argument of such a process. Like the standard input that it reads, it is no interface.
pub const ARGUMENT: &str = "--render-templates";

/// Time of a processor that a process may take, and the whole seconds after which the kernel ends it if it does not itself. All
/// templates of a checkpoint that need a process share it.
const TIME: Duration = Duration::from_millis(400);
const SECONDS: u64 = 1;

/// Bytes of address space, the program itself among them.
const MEMORY: u64 = 256 << 20;

/// Time that a process may take on a machine that gives it no processor.
const PATIENCE: Duration = Duration::from_mins(1);

/// Longest job and longest sum of answers that are read, in bytes: 16 templates, of which each has 60 kB and writes 256 KiB,
/// in JSON that escapes every byte.
const MAX_JOB: u64 = 16 << 20;
const MAX_ANSWERS: u64 = 64 << 20;

/// Renders templates in a process of their own; [`crate::check::render_elsewhere`] gets it.
pub fn render(job: &RenderJob) -> Result<Vec<Rendering>, String> {
    let text = serde_json::to_string(job).map_err(|error| error.to_string())?;
    let (status, answers) = run(&text).map_err(|error| format!("no process for it could be started: {error}"))?;
    // A last line without an end is one that the process was ended in.
    let whole = answers.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    let answers: Vec<Rendering> = whole.map_while(|line| serde_json::from_str(line).ok()).collect();
    if answers.is_empty() && status.code() == Some(i32::from(FAILED)) {
        return Err("the memory of a process cannot be limited here".to_owned());
    }
    Ok(answers)
}

/// Runs the process to its end, which it sees to itself; its status, and what it wrote.
fn run(job: &str) -> std::io::Result<(ExitStatus, String)> {
    let mut command = Command::new(system::program()?);
    command.arg(ARGUMENT).env_clear().stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = command.spawn()?;
    // It reads all of the job before it answers. One that ended reads nothing.
    let _written = child.stdin.take().map(|mut input| input.write_all(job.as_bytes()));
    let mut answers = Vec::new();
    let _read = child.stdout.take().map(|output| output.take(MAX_ANSWERS).read_to_end(&mut answers));
    Ok((child.wait()?, String::from_utf8(answers).unwrap_or_default()))
}

/// Ends this process when it has taken [`TIME`] of a processor, or runs for longer than [`PATIENCE`].
fn watch() -> std::io::Result<()> {
    let begun = Instant::now();
    let watch = move || {
        while begun.elapsed() < PATIENCE && system::taken().is_some_and(|taken| taken < TIME) {
            thread::sleep(Duration::from_millis(10));
        }
        std::process::abort();
    };
    thread::Builder::new().stack_size(64 << 10).spawn(watch).map(|_| ())
}

/// The process itself: limits itself, reads the job, and writes a line for each template.
pub fn main() -> u8 {
    if system::limit(SECONDS, MEMORY).and_then(|()| watch()).is_err() {
        return FAILED;
    }
    let mut text = String::new();
    let job = std::io::stdin().lock().take(MAX_JOB).read_to_string(&mut text).map(|_| serde_json::from_str(&text));
    let Ok(Ok(job)) = job else { return FAILED };
    let job: RenderJob = job;
    let mut out = std::io::stdout().lock();
    job.render(|rendering| {
        let line = serde_json::to_string(rendering).unwrap_or_default();
        let _written = writeln!(out, "{line}").and_then(|()| out.flush());
    });
    CLEAN
}
