//! What depends on the operating system when a checkpoint is read: one file for Unix and one for Windows, with the same
//! functions. `open`, `list`, `contents` and `shard` call them; nothing else below `src/checkpoint/` names a system.

use std::path::Path;

#[cfg(unix)]
mod mapped;
#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(unix)]
pub(crate) use mapped::with_window;
#[cfg(unix)]
pub(crate) use unix::*;
#[cfg(windows)]
pub(crate) use windows::*;

/// Names that Windows gives to devices in every folder, with any extension. Source:
/// <https://learn.microsoft.com/windows/win32/fileio/naming-a-file>.
const DEVICES: [&str; 7] = ["CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$", "CLOCK$"];

/// Whether Windows opens the file of this very name: not a device, not a stream, and not a name that it shortens.
///
/// `open` calls it on Windows for the last component of every path. A file of any other name cannot be listed there.
pub(crate) fn is_windows_file_name(name: &str) -> bool {
    let is_char = |c: char| !c.is_control() && !matches!(c, '<' | '>' | ':' | '"' | '/' | '\\' | '|' | '?' | '*');
    let is_whole = !name.is_empty() && !name.ends_with(['.', ' ']);
    is_whole && name.chars().all(is_char) && !is_device(name)
}

/// `NUL`, `nul.json`, `COM1`, `Lpt¹ .txt`.
fn is_device(name: &str) -> bool {
    let stem = name.split('.').next().unwrap_or_default().trim_end_matches(' ').to_ascii_uppercase();
    let port = stem.strip_prefix("COM").or_else(|| stem.strip_prefix("LPT"));
    let mut number = port.unwrap_or_default().chars();
    let is_port = number.next().is_some_and(|c| c.is_ascii_digit() || matches!(c, '¹' | '²' | '³'));
    DEVICES.contains(&stem.as_str()) || is_port && number.next().is_none()
}

/// A path as reports show it: with `/` on every system. Called for every path of the user that a report contains.
#[must_use]
pub(crate) fn shown(path: &Path) -> String {
    slashed(&path.display().to_string(), std::path::MAIN_SEPARATOR)
}

/// Replaces the separator of a system by `/`.
fn slashed(path: &str, separator: char) -> String {
    path.replace(separator, "/")
}

/// A path that Windows resolved, as users write it: Windows adds a prefix, by which it equals no other path. `windows` calls
/// it, so that a folder above the working directory and a resolved one can be compared.
#[cfg_attr(unix, allow(dead_code, reason = "Windows calls it, and its test runs everywhere"))]
fn without_prefix(path: &str) -> String {
    match path.strip_prefix(r"\\?\UNC\") {
        Some(share) => format!(r"\\{share}"),
        None => path.strip_prefix(r"\\?\").unwrap_or(path).to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::is_plain_file_name;

    #[test]
    fn windows_opens_a_file_under_its_own_name_alone() {
        for name in ["config.json", "model-00001-of-00002.safetensors", "console.json", "com.json", "COM10", "ü", ".x"]
        {
            assert!(is_windows_file_name(name), "{name}");
        }
        let devices =
            ["NUL", "nul", "con.json", "AUX.tar.gz", "com1", "COM0.py", "LPT¹", "lpt9.txt", "CONIN$", "nul .x"];
        let others =
            ["", ".", "..", "config.json.", "config.json ", "config.json::$DATA", "C:config.json", "a\\b", "a/b"];
        for name in devices.into_iter().chain(others).chain(["a*", "a?b", "a\nb", "\\\\?\\C:", "<", "a|b"]) {
            assert!(!is_windows_file_name(name), "{name}");
        }
    }

    #[test]
    fn names_that_leave_the_directory_are_plain_on_no_system() {
        for name in ["..\\up", "C:", "C:\\x", "c:x", "\\\\host\\share", "\\\\.\\NUL", "a\\..\\..\\b", "x:stream", "/x"]
        {
            assert!(!is_plain_file_name(name), "{name}");
        }
    }

    #[test]
    fn resolved_paths_are_as_users_write_them() {
        for (resolved, written) in [
            (r"\\?\C:\models", r"C:\models"),
            (r"\\?\UNC\host\share\a", r"\\host\share\a"),
            (r"C:\models", r"C:\models"),
            ("models", "models"),
        ] {
            assert_eq!(without_prefix(resolved), written);
        }
    }

    #[test]
    fn reports_show_paths_with_slashes() {
        assert_eq!(slashed("models\\llama/part", '\\'), "models/llama/part");
        assert_eq!(slashed("models\\llama", '/'), "models\\llama");
    }
}
