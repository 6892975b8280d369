//! Checks the directories of a zoo in workers: the program, started again with [`ARGUMENT`] and the arguments of the run.
//!
//! A worker reads the versions and the directories of the run and then numbers of those to check, and answers each with the
//! report. One that is ended, by its own abort or by the kernel, costs the report of the directory that it was at, and no other.

use std::ffi::{OsStr, OsString};
use std::io::{self, BufRead, BufReader, Read as _, Write as _};
use std::os::unix::ffi::{OsStrExt as _, OsStringExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Duration;

use clap::Parser as _;

use super::args::{Cli, Command as Subcommand};
use super::exit::{CLEAN, FAILED};
use super::fix::Preview;
use super::look::{Answer, CheckRun, Looked, Stop};
use super::{output, signals, system};
use crate::checkpoint::{parallel, telling_all};

/// The first argument of a worker. Like its standard input, it is no interface.
pub const ARGUMENT: &str = "--check-in-worker";

/// Bytes on standard error that are read of a worker that ended: more than a pipe holds.
const LAST_WORDS: u64 = 1 << 20;

/// Time after which a wait for an answer looks for a signal, if none wakes it.
const PULSE: Duration = Duration::from_millis(200);

/// Asks for each directory in this many workers; the answers in their order. Where no worker can be started, a directory is
/// looked at in this process.
pub fn ask<T: Answer>(run: &CheckRun<'_>, dirs: &[PathBuf], workers: usize) -> Vec<Result<T, Stop>> {
    let numbers: Vec<usize> = (0..dirs.len()).collect();
    parallel::map(workers, &numbers, || None, |worker, number| ask_one(run, dirs, worker, *number))
}

/// Asks one worker for a directory when its answer is asked for.
pub fn ask_in_turn<'d, T: Answer + 'd>(
    run: &'d CheckRun<'_>,
    dirs: &'d [PathBuf],
) -> Box<dyn Iterator<Item = Result<T, Stop>> + 'd> {
    let mut worker = None;
    Box::new((0..dirs.len()).map(move |number| ask_one(run, dirs, &mut worker, number)))
}

/// Asks the worker, or a new one, for the directory of this number.
fn ask_one<T: Answer>(
    run: &CheckRun<'_>,
    dirs: &[PathBuf],
    worker: &mut Option<Worker>,
    number: usize,
) -> Result<T, Stop> {
    let Some(dir) = dirs.get(number) else { return Err(Stop::Directory(String::new())) };
    let Some(mut live) = worker.take().or_else(|| Worker::start(run, dirs).ok()) else { return T::of(run, dir) };
    match live.ask(number) {
        // Only the worker was told to stop.
        Ok(Err(Stop::Interrupted)) if signals::received().is_none() => {
            let reason = "the process that repaired it was told to stop; nothing was written";
            Err(Stop::Directory(reason.to_owned()))
        }
        Ok(answer) => {
            *worker = Some(live);
            answer
        }
        Err(_) => Err(Stop::Directory(live.cause_of_death(run.args.fix.writes()))),
    }
}

/// A list for a worker: each text and the list end with a zero.
fn list<'t>(texts: impl Iterator<Item = &'t [u8]>) -> Vec<u8> {
    let mut list: Vec<u8> = texts.flat_map(|text| [text, b"\0"].concat()).collect();
    list.push(0);
    list
}

/// Reads what [`list`] wrote.
fn read_list(input: &mut impl BufRead) -> io::Result<Vec<OsString>> {
    let mut list = Vec::new();
    loop {
        let mut text = Vec::new();
        input.read_until(0, &mut text)?;
        text.pop();
        if text.is_empty() {
            return Ok(list);
        }
        list.push(OsString::from_vec(text));
    }
}

/// A process that checks directories, one after another.
struct Worker {
    child: Child,
    /// Closed to end it.
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
}

impl Worker {
    fn start(run: &CheckRun<'_>, dirs: &[PathBuf]) -> io::Result<Self> {
        let mut command = Command::new(system::program()?);
        command.arg(ARGUMENT).args(std::env::args_os().skip(1)).stdin(Stdio::piped()).stdout(Stdio::piped());
        // Runs that write or take long show notes and progress, and these have one worker. Others write nothing there before they
        // end.
        let tells = run.is_long() || run.args.fix.writes();
        command.env("RUST_BACKTRACE", "0");
        let mut child = command.stderr(if tells { Stdio::inherit() } else { Stdio::piped() }).spawn()?;
        let (Some(input), Some(output)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(io::ErrorKind::BrokenPipe.into());
        };
        let mut worker = Self { child, input: Some(input), output: BufReader::new(output) };
        let versions = list(run.by.options.versions.iter().map(String::as_bytes));
        worker.tell(&versions)?;
        worker.tell(&list(dirs.iter().map(|dir| dir.as_os_str().as_bytes())))?;
        Ok(worker)
    }

    fn tell(&mut self, bytes: &[u8]) -> io::Result<()> {
        let input = self.input.as_mut().ok_or(io::ErrorKind::BrokenPipe)?;
        input.write_all(bytes).and_then(|()| input.flush())
    }

    /// Asks for a directory. An error says that the process has ended.
    fn ask<T: Answer>(&mut self, number: usize) -> io::Result<Result<T, Stop>> {
        self.tell(format!("{number}\n").as_bytes())?;
        self.pass_signals_on()?;
        let mut line = Vec::new();
        self.output.read_until(b'\n', &mut line)?;
        Ok(serde_json::from_slice(&line)?)
    }

    /// Waits for an answer or the end of the process, which gets the signal that this process got meanwhile.
    fn pass_signals_on(&self) -> io::Result<()> {
        let mut passed = false;
        loop {
            if let Some(signal) = signals::received().filter(|_| !passed) {
                system::send(&self.child, signal);
                passed = true;
            }
            if system::is_readable(self.output.get_ref(), PULSE)? {
                return Ok(());
            }
        }
    }

    /// Why a process that does not answer has ended, and what to do if it `writes`.
    fn cause_of_death(mut self, writes: bool) -> String {
        self.input = None;
        let ended = self.child.wait().map_or_else(|error| error.to_string(), system::ended);
        let mut words = Vec::new();
        let _read = self.child.stderr.take().map(|error| error.take(LAST_WORDS).read_to_end(&mut words));
        let words = String::from_utf8_lossy(&words).into_owned();
        // Of a panic, the place and the message.
        let lines = words.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with("note:"));
        let said = lines.take(2).collect::<Vec<_>>().join(" ");
        let said = if said.is_empty() { said } else { format!(": {}", output::safe(&said)) };
        let next =
            if writes { "; what it wrote is finished or taken back by the next `check --fix` or `undo`" } else { "" };
        format!("the process that checked it ended with {ended}{said}{next}")
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.input = None;
        let _status = self.child.wait();
    }
}

/// The worker itself.
pub fn main(args: impl Iterator<Item = OsString>) -> u8 {
    match serve(args) {
        Ok(()) => CLEAN,
        Err(error) => {
            output::note(&super::causes(&error));
            FAILED
        }
    }
}

fn serve(args: impl Iterator<Item = OsString>) -> anyhow::Result<()> {
    let Cli { command: Subcommand::Check(mut args), rules } = Cli::try_parse_from(args)? else {
        anyhow::bail!("only check has workers");
    };
    let mut input = io::stdin().lock();
    // The run has read the files that pin them, and asked the interpreter.
    args.versions = read_list(&mut input)?.into_iter().map(|version| version.to_string_lossy().into_owned()).collect();
    let dirs: Vec<PathBuf> = read_list(&mut input)?.into_iter().map(PathBuf::from).collect();
    // The notes on the settings are those of the run.
    let run = output::silently(|| CheckRun::new(&args, rules.as_deref(), &dirs))?;
    let mut line = String::new();
    if args.fix.writes() {
        signals::install()?;
    }
    while input.read_line(&mut line)? > 0 {
        let number: usize = line.trim().parse()?;
        let dir = dirs.get(number).map_or_else(|| Path::new(OsStr::new("")), PathBuf::as_path);
        let mut answer = if args.fix.diff { answer::<Preview>(&run, dir) } else { answer::<Looked>(&run, dir) }?;
        answer.push(b'\n');
        let mut out = io::stdout().lock();
        out.write_all(&answer)?;
        out.flush()?;
        line.clear();
    }
    Ok(())
}

fn answer<T: Answer>(run: &CheckRun<'_>, dir: &Path) -> serde_json::Result<Vec<u8>> {
    let answer = T::of(run, dir);
    telling_all(|| serde_json::to_vec(&answer))
}
