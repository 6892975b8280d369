//! Reads a file of an environment as the versions that it pins.

use std::path::Path;

use super::demand::{Demand, Demands, Distribution, Wanted};
use super::{requirement_file, toml_file};
use crate::checkpoint::escape;
use crate::checkpoint::open::read_capped;
use crate::checkpoint::platform::shown;
use crate::knowledge::loader::{Requirements, parse_program};
use crate::knowledge::source::DataError;

/// Most bytes of a file, or of a requirements file and those that it includes. The largest published lock files have 5 MB.
const MAX_BYTES: u64 = 16 << 20;

/// Most versions that one file may pin: each is judged.
const MAX_PINS: usize = 16;

/// What may be named.
const KINDS: &str = "name a lock file, pyproject.toml or requirements file";

/// Longest text of a file that an error quotes, in characters.
const MAX_QUOTE: usize = 100;

/// The next step after a file that cannot decide.
const NEXT: &str = "name a version with --for, or use a lock file";

/// The versions of transformers and PEFT that a file pins, for the value `@FILE` of `--for`. The file is a requirements file
/// when its name ends with `.txt` or `.in`, and TOML when it ends with `.lock` or `.toml`. Several versions, as of the forks of
/// a uv.lock, are all returned, in the order of the file.
///
/// # Errors
/// A file that cannot be read, is too large or malformed, or that pins no version of transformers, and a version that was never
/// released.
pub fn read_pins(path: &Path) -> Result<Requirements, DataError> {
    let name = shown(path);
    let mut demands = Demands::default();
    match path.extension().unwrap_or_default().to_string_lossy().to_lowercase().as_str() {
        "txt" | "in" => requirement_file::read(path, MAX_BYTES, &mut demands)?,
        "lock" | "toml" => {
            let bytes = read_capped(path, MAX_BYTES).map_err(|error| {
                let reason = error.to_string();
                let reason = reason.strip_prefix(&name).map_or(reason.as_str(), str::trim_start);
                DataError::new(&name, format!("{reason}; {KINDS}"))
            })?;
            let text = String::from_utf8(bytes).map_err(|_| DataError::new(&name, format!("is not UTF-8; {KINDS}")))?;
            toml_file::add_demands(&name, &text, &mut demands)?;
        }
        _ => {
            let reason = "is none of *.lock, *.toml, *.txt and *.in, from which versions are read";
            return Err(DataError::new(&name, format!("{reason}; {KINDS}")));
        }
    }
    pinned(&name, &demands)
}

/// The versions that the demands of a file pin.
fn pinned(name: &str, demands: &Demands) -> Result<Requirements, DataError> {
    let mut texts: Vec<String> = Vec::new();
    for (demand, version) in demands.list.iter().filter_map(exact) {
        let text = format!("{}=={version}", demand.distribution.name());
        let text = parse_program(&text)
            .map_err(|why| demand.wrong(format!("{why}; correct it, or name a version with --for")))?;
        if !texts.contains(&text) {
            texts.push(text);
        }
        if texts.len() > MAX_PINS {
            return Err(demand.wrong(format!("more than {MAX_PINS} versions are pinned; name one with --for")));
        }
    }
    let pins = Requirements::new(&texts);
    if pins.transformers.is_empty() {
        return Err(unpinned(name, demands));
    }
    Ok(pins)
}

/// A demand of one version.
fn exact(demand: &Demand) -> Option<(&Demand, &str)> {
    match &demand.wanted {
        Wanted::Exactly(version) => Some((demand, version)),
        Wanted::Otherwise(_) => None,
    }
}

/// Why the demands of a file pin no version of transformers.
fn unpinned(name: &str, demands: &Demands) -> DataError {
    let range = demands.list.iter().find_map(|demand| match &demand.wanted {
        Wanted::Otherwise(words) if demand.distribution == Distribution::Transformers => Some((demand, words)),
        _ => None,
    });
    if let Some((demand, words)) = range {
        let words = escape(&format!("transformers {words}"), MAX_QUOTE);
        return demand.wrong(format!("asks for {} and pins none: {NEXT}", words.trim_end()));
    }
    let left_out = demands.not_followed.as_ref().map_or_else(String::new, |file| {
        format!(" (its include {} is not read: only relative paths are)", escape(file, MAX_QUOTE))
    });
    DataError::new(name, format!("names no version of transformers{left_out}: {NEXT}"))
}
