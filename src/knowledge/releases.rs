//! Versions of libraries that were released: `rules/releases.json`.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use super::source;

/// By library, the last patch of each minor version. A test reads the file.
type Releases = BTreeMap<String, BTreeMap<String, u64>>;

static RELEASES: LazyLock<Releases> = LazyLock::new(|| {
    let file = "releases.json";
    source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
        .unwrap_or_else(|error| panic!("{error}"))
});

/// The leading numbers of a version, which order versions: 5, 0, 0 of `5.0.0rc1`.
#[must_use]
pub fn version_numbers(version: &str) -> Vec<u64> {
    let digits = |part: &str| part.split(|c: char| !c.is_ascii_digit()).next().unwrap_or_default().parse().ok();
    version.split('.').map_while(digits).collect()
}

/// Why nobody can have a version of a library: it was never released, and never will be. `None` for a version that may exist,
/// such as a newer one, a development build, or a number that stands for many.
#[must_use]
pub(super) fn objection(library: &str, version: &str) -> Option<String> {
    let minors: BTreeMap<(u64, u64), u64> =
        RELEASES.get(library)?.iter().filter_map(|(minor, patch)| Some((pair(minor)?, *patch))).collect();
    if !version.bytes().all(|b| b.is_ascii_digit() || b == b'.') {
        return None;
    }
    let minor = pair(version)?;
    let (newest, _) = minors.last_key_value()?;
    if minor >= *newest {
        return None;
    }
    let shown = |((major, minor), patch): (&(u64, u64), &u64)| format!("{major}.{minor}.{patch}");
    let never = format!("{library} {version} was never released");
    match (minors.get_key_value(&minor), version_numbers(version).get(2)) {
        (Some((_, last)), Some(patch)) if patch > last => {
            Some(format!("{never}: {} is the last {}.{}", shown((&minor, last)), minor.0, minor.1))
        }
        (Some(_), _) => None,
        (None, _) => {
            let next = minors.range(minor..).next().map(|((major, minor), _)| format!("{major}.{minor}.0"));
            let neighbours = minors.range(..minor).next_back().map(shown).into_iter().chain(next);
            Some(format!("{never}: its neighbours are {}", neighbours.collect::<Vec<_>>().join(" and ")))
        }
    }
}

fn pair(version: &str) -> Option<(u64, u64)> {
    match version_numbers(version).as_slice() {
        [major, minor, ..] => Some((*major, *minor)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::knowledge::Loader;

    #[test]
    fn a_version_that_was_never_released_is_told_from_one_that_may_exist() {
        for version in ["4.57.6", "4.57.0", "4.57", "4", "5.99.1", "6.0", "4.58.0.dev0", "5.0.0rc1", "main", "4.50.3"] {
            assert_eq!(objection("transformers", version), None, "{version}");
        }
        for (library, version, why) in [
            ("transformers", "4.50.9", "transformers 4.50.9 was never released: 4.50.3 is the last 4.50"),
            ("transformers", "4.58", "transformers 4.58 was never released: its neighbours are 4.57.6 and 5.0.0"),
            ("transformers", "4.99.1", "transformers 4.99.1 was never released: its neighbours are 4.57.6 and 5.0.0"),
            ("transformers", "0.0", "transformers 0.0 was never released: its neighbours are 0.1.0"),
            ("peft", "0.13.9", "peft 0.13.9 was never released: 0.13.2 is the last 0.13"),
        ] {
            assert_eq!(objection(library, version).as_deref(), Some(why));
        }
        for loader in Loader::ALL {
            assert!(RELEASES["transformers"].contains_key(loader.version().rsplit_once('.').unwrap().0), "{loader}");
        }
    }
}
