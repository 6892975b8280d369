//! Runs the program on a case within limits, and observes its effects.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::mem::MaybeUninit;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use ckpt_doctor::checkpoint::escape;
use rustix::fs::inotify::{self, CreateFlags, ReadFlags, Reader, WatchFlags};
use serde_json::Value;
use tempfile::TempDir;

use super::ANYTHING;
use super::place::Dir;

/// Limit of the address space for each checkpoint of a run.
const MEMORY_KIB: u64 = 256 << 10;
/// Limit of CPU seconds for each checkpoint of a run, for the test build.
const CPU: u64 = 20;
/// Wall-clock limit: a longer run hangs, on any machine.
const PATIENCE: Duration = Duration::from_mins(2);
/// Maximum number of bytes printed for one checkpoint.
const SCREEN: usize = 64 << 10;
/// Programs that content of a checkpoint might start.
const PROGRAMS: [&str; 8] = ["python", "python3", "sh", "bash", "git", "git-lfs", "curl", "wget"];

/// Data shared by all cases.
pub struct Bench {
    temporary: TempDir,
}

/// Result of a run.
pub struct Verdict {
    status: Option<ExitStatus>,
    /// The findings.
    report: Value,
    terminal: Vec<u8>,
    /// Files outside the checkpoint that were opened, and files written inside it.
    touched: Vec<String>,
}

impl Bench {
    pub fn new() -> Self {
        let temporary = TempDir::new().unwrap();
        let programs = temporary.path().join("bin");
        fs::create_dir(&programs).unwrap();
        for name in PROGRAMS {
            fs::write(programs.join(name), "").unwrap();
        }
        Self { temporary }
    }

    /// Builds a case and runs `check` on it.
    pub fn judge(&self, number: usize, make: &dyn Fn(&Dir)) -> Verdict {
        let room = self.temporary.path().join(number.to_string());
        let dir = Dir::new(&room);
        make(&dir);
        let verdict = self.watch(&room, &dir, 1, &["check".as_ref(), dir.root.as_os_str()]);
        fs::remove_dir_all(&room).unwrap();
        verdict
    }

    /// Creates a directory for one case.
    pub fn room(&self, name: &str) -> PathBuf {
        self.temporary.path().join(name)
    }

    /// Runs the program on `checkpoints` checkpoints, and watches this one, its surroundings, and the programs that
    /// must not start.
    pub fn watch(&self, room: &Path, dir: &Dir, checkpoints: u64, args: &[&OsStr]) -> Verdict {
        let programs = self.temporary.path().join("bin");
        let watch = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).unwrap();
        let writes =
            WatchFlags::CREATE | WatchFlags::MODIFY | WatchFlags::DELETE | WatchFlags::MOVE | WatchFlags::ATTRIB;
        for (path, flags) in
            [(&dir.outer, writes | WatchFlags::OPEN), (&dir.root, writes), (&programs, writes | WatchFlags::OPEN)]
        {
            inotify::add_watch(&watch, path, flags).unwrap();
        }
        let [out, report] = ["out", "report.json"].map(|name| room.join(name));
        let status = run(args, checkpoints, &out, &report, &programs);
        let mut touched = Vec::new();
        let mut buffer = [MaybeUninit::uninit(); 4096];
        let mut events = Reader::new(&watch, &mut buffer);
        while let Ok(event) = events.next() {
            let name = event.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            // Directories may be listed, including that of the case.
            if !event.events().contains(ReadFlags::ISDIR) {
                touched.push(format!("{name:?} {:?}", event.events()));
            }
        }
        Verdict {
            status,
            report: fs::read(&report).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default(),
            terminal: fs::read(&out).unwrap(),
            touched,
        }
    }
}

/// Path of an optimised program for CI: it runs every case as a donor, with a limit of two seconds.
pub fn optimised() -> Option<OsString> {
    std::env::var_os("CKPT_DOCTOR_OPTIMISED")
}

/// The size of a large case: as given for an optimised program, and a tenth for the test build, which reads ten times
/// slower. The verdicts are the same.
pub fn large(size: usize) -> usize {
    if optimised().is_some() { size } else { size / 10 }
}

/// The exit status; `None` if the run did not end. The shell sets the limits and is replaced by the program.
fn run(args: &[&OsStr], checkpoints: u64, out: &Path, report: &Path, programs: &Path) -> Option<ExitStatus> {
    let optimised = optimised();
    let cpu = checkpoints * if optimised.is_some() { 2 } else { CPU };
    let memory = checkpoints * MEMORY_KIB;
    let limits = format!("ulimit -c 0 && ulimit -v {memory} && ulimit -t {cpu} && exec \"$0\" \"$@\"");
    let output = File::create(out).unwrap();
    let mut child = Command::new("/bin/sh")
        .args(["-c", &limits])
        .arg(optimised.unwrap_or_else(|| env!("CARGO_BIN_EXE_ckpt-doctor").into()))
        .args(args)
        .arg("--report")
        .arg(format!("json={}", report.display()))
        .env("PATH", programs)
        .env("XDG_STATE_HOME", crate::support::state())
        .stdin(Stdio::null())
        .stdout(output.try_clone().unwrap())
        .stderr(output)
        .spawn()
        .unwrap();
    let begun = Instant::now();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return Some(status);
        }
        if begun.elapsed() > PATIENCE {
            child.kill().unwrap();
            child.wait().unwrap();
            return None;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

impl Verdict {
    fn findings(&self) -> impl Iterator<Item = &Value> {
        self.report["checkpoints"].as_array().into_iter().flatten().flat_map(|c| c["findings"].as_array().unwrap())
    }

    /// The exit code, or the signal or timeout that ended the process.
    pub fn exit(&self) -> String {
        match self.status.map(|s| (s.code(), s.signal())) {
            None => "hangs".to_owned(),
            Some((Some(code), _)) => code.to_string(),
            Some((None, signal)) => format!("signal {}", signal.unwrap_or_default()),
        }
    }

    /// Every code found, with a count if more than one.
    pub fn codes(&self) -> String {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for finding in self.findings() {
            *counts.entry(finding["code"].as_str().unwrap()).or_default() += 1;
        }
        let words = counts.into_iter().map(|(code, n)| if n == 1 { code.to_owned() } else { format!("{code}×{n}") });
        words.collect::<Vec<_>>().join(" ")
    }

    /// Description of a failed case.
    pub fn shown(&self) -> String {
        let mut lines = vec![format!("exit {}: {}", self.exit(), self.codes())];
        lines.extend(self.findings().take(4).map(|f| format!("{} {} {}", f["code"], f["message"], f["locations"])));
        lines.push(self.text().chars().take(600).collect());
        lines.join("\n    ")
    }

    /// Problems of the verdict.
    pub fn complaints(&self, wanted: &[&str], at: &str) -> Vec<String> {
        let mut complaints = Vec::new();
        let mut hold = |is: bool, what: &str| {
            if !is {
                complaints.push(what.to_owned());
            }
        };
        let severe = |severity: &str| self.findings().any(|f| f["severity"] == severity);
        hold(self.exit() == if severe("error") { "1" } else { "0" }, "the exit code is not what the findings ask for");
        hold(self.report["schema"].is_u64(), "there is no report");
        hold(!wanted.is_empty() || !severe("error") && !severe("warning"), "it is sound, and something is found");
        for code in wanted.iter().filter(|code| **code != ANYTHING) {
            let own: Vec<_> = self.findings().filter(|f| f["code"] == *code).collect();
            hold(!own.is_empty(), &format!("{code} is silent"));
            hold(own.iter().any(|f| names(f, at)), &format!("{code} does not name {at}"));
        }
        for finding in self.findings().filter(|f| f["severity"] != "info") {
            let step = ["title", "help"].into_iter().find_map(|key| finding["fix"][key].as_str()).unwrap_or_default();
            hold(!step.is_empty(), &format!("{} has neither a fix nor help", finding["code"]));
        }
        complaints.extend(self.conduct());
        complaints
    }

    /// Problems of the program's behaviour, independent of its findings.
    pub fn conduct(&self) -> Vec<String> {
        let text = self.text();
        let held = [
            (!text.contains(|c| c != '\n' && steers(c)), "a character that steers the terminal comes out".to_owned()),
            (self.terminal.len() <= SCREEN, format!("{} bytes on the terminal", self.terminal.len())),
            (!text.contains("panicked"), "it panics".to_owned()),
            (self.touched.is_empty(), format!("it touches {:?}", self.touched)),
        ];
        held.into_iter().filter(|(is, _)| !is).map(|(_, what)| what).collect()
    }

    /// The output on the terminal.
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.terminal).into_owned()
    }
}

/// Whether a finding contains `at` in one of its locations or in its message.
fn names(finding: &Value, at: &str) -> bool {
    let has = |value: &Value| value.as_str().is_some_and(|text| text.contains(at));
    let located = |l: &Value| ["file", "tensor", "pointer"].iter().any(|key| has(&l[*key]));
    at.is_empty() || finding["locations"].as_array().unwrap().iter().any(located) || has(&finding["message"])
}

/// Whether a character controls a terminal, or hides or reorders text.
fn steers(c: char) -> bool {
    c.is_control() || escape(c.encode_utf8(&mut [0; 4]), 1).contains("\\u{")
}
