//! `--for-python`: asks a Python interpreter which versions are installed for it.
//!
//! This is the only program other than ckpt-doctor itself that a run starts, and only because the command line names it. It
//! imports nothing but the standard library, and what the environment itself imports at every start.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::Read;
use std::path::{Path, PathBuf, absolute};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};

use super::{output, system};
use crate::knowledge::loader::{Requirements, parse_program};

/// Prints the versions of installed distributions as one line of JSON. `importlib.metadata` reads their metadata and imports none.
const PROGRAM: &str = r#"
import importlib.metadata, json
found = {}
for name in ("transformers", "peft"):
    try:
        found[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        pass
print("\n" + json.dumps(found))
"#;

/// Time for an interpreter to answer.
const TIME: Duration = Duration::from_secs(30);

/// Most bytes that are read of its output, and of its errors.
const MAX_OUTPUT: u64 = 64 << 10;

/// Variables of the environment that it gets: those that an interpreter may need to start. It gets no secret, and `-I` passes
/// over those of Python.
const VARIABLES: [&str; 6] = ["PATH", "HOME", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "SYSTEMROOT", "TEMP"];

/// The versions that are installed for an interpreter, as values of `--for`. `checkpoints` are the directories of the run, of
/// which nothing is started.
///
/// # Errors
/// An interpreter that lies in a checkpoint, cannot be started, fails, does not end, prints too much or anything else, and one
/// without transformers.
pub fn versions(python: &Path, checkpoints: &[PathBuf]) -> anyhow::Result<Vec<String>> {
    let program = located(python, checkpoints)?;
    installed(&program, TIME).with_context(|| format!("--for-python {}", python.display()))
}

/// The program to start: a name is looked for on the `PATH`, and a path is made absolute, because the process starts in another
/// directory. A link is kept: its place tells an interpreter its environment.
fn located(python: &Path, checkpoints: &[PathBuf]) -> anyhow::Result<PathBuf> {
    if python.components().count() < 2 && !python.has_root() {
        return Ok(python.to_owned());
    }
    let program = absolute(python).with_context(|| format!("--for-python {}", python.display()))?;
    let real = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let folder = real(program.parent().unwrap_or(&program));
    if let Some(dir) =
        checkpoints.iter().find(|dir| folder.starts_with(real(dir)) || real(&program).starts_with(real(dir)))
    {
        let (python, dir) = (python.display(), dir.display());
        bail!(
            "--for-python {python}: lies in the checkpoint {dir}, of which nothing is run; name an interpreter elsewhere"
        );
    }
    Ok(program)
}

fn installed(program: &Path, time: Duration) -> anyhow::Result<Vec<String>> {
    let (status, printed, errors) = answer(program, time)?;
    if !status.success() {
        let last = errors.lines().rev().map(str::trim).find(|line| !line.is_empty()).unwrap_or("it printed no error");
        let last: String = last.chars().take(200).collect();
        bail!(
            "ended with {}: {}; name an interpreter of Python 3.8 or newer",
            system::ended(status),
            output::safe(&last)
        );
    }
    let line = printed.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or_default();
    let found: BTreeMap<String, Option<String>> = serde_json::from_str(line)
        .map_err(|_| anyhow::anyhow!("printed no list of versions; name an interpreter of Python 3.8 or newer"))?;
    let version = |name: &str| Some(format!("{name}=={}", found.get(name)?.as_ref()?));
    let texts = ["transformers", "peft"].into_iter().filter_map(version);
    let texts: Vec<String> =
        texts.map(|text| parse_program(&text)).collect::<Result<_, _>>().map_err(anyhow::Error::msg)?;
    if Requirements::new(&texts).transformers.is_empty() {
        bail!("has no transformers; name the interpreter of the environment that loads the model");
    }
    Ok(texts)
}

/// Runs the interpreter to its end; its status, output and errors.
fn answer(program: &Path, time: Duration) -> anyhow::Result<(ExitStatus, String, String)> {
    let until = Instant::now().checked_add(time);
    let mut command = Command::new(program);
    command.args(["-I", "-c", PROGRAM]).env_clear().envs(variables());
    command.current_dir(neutral()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => anyhow::anyhow!("does not exist; name a Python interpreter"),
        _ => anyhow::anyhow!("cannot be started: {error}; name a Python interpreter"),
    })?;
    let (printed, errors) = (reader(child.stdout.take())?, reader(child.stderr.take())?);
    let result = ended(&mut child, until, &printed, &errors);
    if result.is_err() {
        let _killed = child.kill();
        let _status = child.wait();
    }
    result
}

/// Waits for the process and what it prints. A process that it started may hold its output open: that counts as well.
fn ended(
    child: &mut Child,
    until: Option<Instant>,
    printed: &Receiver<Vec<u8>>,
    errors: &Receiver<Vec<u8>>,
) -> anyhow::Result<(ExitStatus, String, String)> {
    let left = || until.map_or(Duration::ZERO, |until| until.saturating_duration_since(Instant::now()));
    let text = |from: &Receiver<Vec<u8>>| match from.recv_timeout(left()) {
        Ok(bytes) if u64::try_from(bytes.len()).is_ok_and(|n| n > MAX_OUTPUT) => {
            bail!("printed more than {MAX_OUTPUT} bytes; name a Python interpreter")
        }
        Ok(bytes) => Ok(String::from_utf8_lossy(&bytes).into_owned()),
        Err(RecvTimeoutError::Timeout) => bail!("did not end in {} s; name the versions with --for", TIME.as_secs()),
        Err(RecvTimeoutError::Disconnected) => bail!("its output cannot be read"),
    };
    let (printed, errors) = (text(printed)?, text(errors)?);
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok((status, printed, errors));
        }
        if left().is_zero() {
            bail!("did not end in {} s; name the versions with --for", TIME.as_secs());
        }
        thread::sleep(Duration::from_millis(5));
    }
}

/// Reads a stream in a thread, which is left alone when it does not end; one byte more than the limit tells that there are more.
fn reader(stream: Option<impl Read + Send + 'static>) -> anyhow::Result<Receiver<Vec<u8>>> {
    let (sender, receiver) = channel();
    let read = move || {
        let mut bytes = Vec::new();
        let limit = MAX_OUTPUT.saturating_add(1);
        let _read = stream.map(|stream| stream.take(limit).read_to_end(&mut bytes));
        let _sent = sender.send(bytes);
    };
    thread::Builder::new().stack_size(64 << 10).spawn(read)?;
    Ok(receiver)
}

/// The environment of the process.
fn variables() -> Vec<(&'static str, OsString)> {
    VARIABLES.into_iter().filter_map(|name| Some((name, std::env::var_os(name)?))).collect()
}

/// A directory in which the process finds nothing of a checkpoint: the root of the file system.
fn neutral() -> PathBuf {
    let here = std::env::current_dir().unwrap_or_default();
    here.ancestors().last().filter(|root| root.has_root()).map_or_else(|| PathBuf::from("/"), Path::to_owned)
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use std::fs;
    use std::os::unix::fs::PermissionsExt as _;

    use tempfile::TempDir;

    use super::*;

    /// What an interpreter that is this shell script says.
    fn asked(script: &str) -> Result<Vec<String>, String> {
        let work = TempDir::new().unwrap();
        let python = work.path().join("python");
        #[expect(clippy::disallowed_methods, reason = "a test writes its input")]
        fs::write(&python, format!("#!/bin/sh\n{script}\n")).unwrap();
        fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).unwrap();
        loop {
            match installed(&python, Duration::from_millis(1500)).map_err(|error| format!("{error:#}")) {
                // A process that another test starts at this moment holds the file open.
                Err(error) if error.contains("busy") => thread::sleep(Duration::from_millis(5)),
                result => return result,
            }
        }
    }

    #[test]
    fn the_last_line_lists_what_is_installed() {
        let all = asked(r#"echo noise; echo '{"transformers": "4.57.3", "peft": "0.13.2", "other": null}'"#);
        assert_eq!(all.unwrap(), ["4.57.3", "peft==0.13.2"]);
        assert_eq!(asked(r#"echo '{"transformers": "4.57.3", "peft": null}'"#).unwrap(), ["4.57.3"]);
        // Alone, in another directory, and without the secrets of the user.
        let script =
            r#"[ "$1" = -I ] && [ "$(pwd)" = / ] && [ -z "$CARGO_MANIFEST_DIR" ] && echo '{"transformers": "5.0.0"}'"#;
        assert_eq!(asked(script).unwrap(), ["5.0.0"]);
    }

    #[test]
    fn an_interpreter_that_does_not_answer_is_an_error() {
        for (script, why) in [
            ("exit 3", "ended with exit code 3: it printed no error"),
            ("echo 'ImportError: \u{1b}[1m no json' >&2; exit 1", r"exit code 1: ImportError: \u{1b}[1m no json"),
            ("kill -9 $$", "ended with SIGKILL"),
            ("echo '{}'", "has no transformers"),
            (r#"echo '{"peft": "0.13.2"}'"#, "has no transformers"),
            (r#"echo '{"transformers": "4.50.9"}'"#, "transformers 4.50.9 was never released"),
            ("echo hello", "printed no list of versions"),
            ("", "printed no list of versions"),
            ("yes", "printed more than 65536 bytes"),
            ("yes >&2", "printed more than 65536 bytes"),
            ("sleep 20 & exit 0", "did not end in 30 s"),
            ("exec >/dev/null 2>&1; sleep 20", "did not end in 30 s"),
        ] {
            let error = asked(script).unwrap_err();
            assert!(error.contains(why), "{script}: {error}");
        }
        let error = installed(Path::new("/nowhere/python"), TIME).unwrap_err().to_string();
        assert_eq!(error, "does not exist; name a Python interpreter");
    }

    #[test]
    fn nothing_of_a_checkpoint_is_started() {
        let work = TempDir::new().unwrap();
        let dirs = [work.path().to_owned()];
        assert!(located(&work.path().join("bin/../python"), &dirs).unwrap_err().to_string().contains("nothing is run"));
        assert_eq!(located(Path::new("python3"), &dirs).unwrap(), Path::new("python3"));
        assert_eq!(located(Path::new("/usr/bin/python3"), &dirs).unwrap(), Path::new("/usr/bin/python3"));
    }
}
