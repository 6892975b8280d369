//! The tensors of a result that must be trained, and one regular expression for their names.

use std::collections::{BTreeSet, HashSet};

use crate::report::model::Training;

/// The training record of a result with the tensors `names`, of which those in `train` must be trained.
pub(super) fn training<'n>(names: impl Iterator<Item = &'n str>, train: &BTreeSet<String>) -> Training {
    let (train, freeze): (Vec<&str>, Vec<&str>) = names.partition(|name| train.contains(*name));
    let pattern = (!train.is_empty()).then(|| pattern(&train, &freeze));
    let owned = |names: Vec<&str>| names.into_iter().map(str::to_owned).collect();
    Training { pattern, train: owned(train), freeze: owned(freeze) }
}

/// An anchored regular expression that matches every name of `train` and none of `freeze`, in the syntax that Rust and
/// Python share.
fn pattern(train: &[&str], freeze: &[&str]) -> String {
    // A general expression matches a name exactly if the general expression of the name is the same.
    let frozen: HashSet<String> = freeze.iter().map(|name| any_number(name)).collect();
    let part = |name: &&str| Some(any_number(name)).filter(|general| !frozen.contains(general));
    let parts: BTreeSet<String> = train.iter().map(|name| part(name).unwrap_or_else(|| regex::escape(name))).collect();
    let parts: Vec<String> = parts.into_iter().collect();
    format!("^(?:{})$", parts.join("|"))
}

/// The escaped name with any number in place of each segment that is a number, such as the index of a layer.
fn any_number(name: &str) -> String {
    let is_number = |segment: &str| !segment.is_empty() && segment.bytes().all(|b| b.is_ascii_digit());
    let segments = name.split('.');
    let segments: Vec<String> =
        segments.map(|s| if is_number(s) { "[0-9]+".to_owned() } else { regex::escape(s) }).collect();
    segments.join("\\.")
}

#[cfg(test)]
mod tests {
    use regex::Regex;

    use super::*;

    /// The names that the pattern matches are exactly those to train.
    fn check(train: &[&str], freeze: &[&str]) -> String {
        let pattern = pattern(train, freeze);
        let regex = Regex::new(&pattern).unwrap();
        for name in train {
            assert!(regex.is_match(name), "{pattern} and {name}");
        }
        for name in freeze {
            assert!(!regex.is_match(name), "{pattern} and {name}");
        }
        pattern
    }

    #[test]
    fn numbers_are_generalised_where_no_frozen_name_matches() {
        let layers = ["layers.0.q.weight", "layers.1.q.weight"];
        assert_eq!(check(&layers, &["layers.0.k.weight"]), r"^(?:layers\.[0-9]+\.q\.weight)$");
        let exact = r"^(?:layers\.0\.q\.weight|layers\.1\.q\.weight)$";
        assert_eq!(check(&layers, &["layers.2.q.weight"]), exact);
        check(&["a"], &["ab", "xa", "A"]);
        check(&["a.b"], &["aXb", "a.b.c"]);
        check(&["a|b", "(", "x\ny", "^$", ""], &["a", "b", " ", "x", "y"]);
        check(&["a.1.2", "a.3.4"], &["a.1.4"]);
    }

    #[test]
    fn without_names_there_is_no_pattern() {
        let none = training(["a", "b"].into_iter(), &BTreeSet::new());
        assert_eq!((none.pattern, none.train.len(), none.freeze.len()), (None, 0, 2));
    }
}
