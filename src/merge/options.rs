//! Options of a recipe: validates the given ones, and adds defaults for the others.

use std::collections::BTreeMap;

use super::error::MergeError;
use crate::checkpoint::module::is_dotted_name;
use crate::knowledge::recipe::{OptionKind, OptionSpec, Recipe};
use crate::knowledge::source::hint;

/// Options with their values, by name.
pub type Options = BTreeMap<String, String>;

/// Shard size of a recipe without this option: the default of `save_pretrained`.
pub(super) const DEFAULT_SHARD: u64 = 5_000_000_000;

/// The options with their values: the given ones, and the recipe's defaults for the others.
///
/// # Errors
/// [`MergeError::Option`] for an unknown name or an invalid value.
pub(super) fn resolve(recipe: &Recipe, given: &BTreeMap<String, String>) -> Result<Options, MergeError> {
    for name in given.keys() {
        if !recipe.options.iter().any(|o| o.name == *name) {
            let known: Vec<&str> = recipe.options.iter().map(|o| o.name.as_str()).collect();
            let hint = hint(name, &known);
            return Err(MergeError::Option(format!("recipe {} has no option {name}; {hint}", recipe.recipe)));
        }
    }
    recipe
        .options
        .iter()
        .map(|spec| {
            let value = given.get(&spec.name).unwrap_or(&spec.default);
            check(spec, value)?;
            Ok((spec.name.clone(), value.clone()))
        })
        .collect()
}

/// Checks a value of an option.
///
/// # Errors
/// [`MergeError::Option`] with the allowed values.
pub(super) fn check(spec: &OptionSpec, value: &str) -> Result<(), MergeError> {
    match spec.kind() {
        OptionKind::Size => return parse_size(&spec.name, value).map(drop),
        OptionKind::Integer => return parse_integer(&spec.name, value).map(drop),
        OptionKind::Number => return parse_number(&spec.name, value).map(drop),
        OptionKind::Text => return check_text(&spec.name, value),
        OptionKind::Choice => {}
    }
    let takes = |v: &String| match v.strip_suffix(':') {
        // The argument after the colon becomes part of a Python import, so it must be a dotted module path.
        Some(head) => value.strip_prefix(head).and_then(|t| t.strip_prefix(':')).is_some_and(is_dotted_name),
        None => v == value,
    };
    if spec.values.iter().any(takes) {
        return Ok(());
    }
    let forms: Vec<String> =
        spec.values.iter().map(|v| if v.ends_with(':') { format!("{v}PACKAGE") } else { v.clone() }).collect();
    Err(MergeError::Option(format!("{}={value} is not one of {}", spec.name, forms.join(", "))))
}

/// The value of an option of kind `integer`.
///
/// # Errors
/// [`MergeError::Option`] for anything else.
pub(super) fn parse_integer(name: &str, text: &str) -> Result<i64, MergeError> {
    text.parse().map_err(|_| MergeError::Option(format!("{name}={text} is not an integer")))
}

/// The value of an option of kind `number`.
///
/// # Errors
/// [`MergeError::Option`] for anything else.
pub(super) fn parse_number(name: &str, text: &str) -> Result<f64, MergeError> {
    let number = text.parse().ok().filter(|number: &f64| number.is_normal() && *number > 0.0);
    number.ok_or_else(|| MergeError::Option(format!("{name}={text} is not a number above 0 such as 0.25")))
}

/// Longest value of an option of kind `text`, in bytes.
const MAX_TEXT: usize = 1000;

fn check_text(name: &str, text: &str) -> Result<(), MergeError> {
    if text.len() > MAX_TEXT {
        return Err(MergeError::Option(format!("{name} has {} bytes; at most {MAX_TEXT} are allowed", text.len())));
    }
    match text.chars().find(|c| c.is_control()) {
        Some(c) => Err(MergeError::Option(format!("{name} contains the control character {c:?}; remove it"))),
        None => Ok(()),
    }
}

/// Bytes of a size such as `5GB` (5·10⁹), `300MiB` (300·2²⁰) or `1000`; at least one.
///
/// # Errors
/// [`MergeError::Option`] for anything else.
pub(super) fn parse_size(name: &str, text: &str) -> Result<u64, MergeError> {
    let bad = || MergeError::Option(format!("{name}={text} is not a size such as 5GB, 300MiB or 1000000"));
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let number: u64 = number.parse().map_err(|_| bad())?;
    let unit: u64 = match unit.trim().to_ascii_uppercase().as_str() {
        "" | "B" => 1,
        "KB" => 1_000,
        "MB" => 1_000_000,
        "GB" => 1_000_000_000,
        "TB" => 1_000_000_000_000,
        "KIB" => 1 << 10,
        "MIB" => 1 << 20,
        "GIB" => 1 << 30,
        "TIB" => 1 << 40,
        _ => return Err(bad()),
    };
    number.checked_mul(unit).filter(|n| *n > 0).ok_or_else(bad)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes() {
        assert_eq!(parse_size("o", "5GB").unwrap(), 5_000_000_000);
        assert_eq!(parse_size("o", "5GiB").unwrap(), 5 << 30);
        assert_eq!(parse_size("o", "300").unwrap(), 300);
        for bad in ["", "GB", "0", "-1", "5 parsecs", "99999999999TB"] {
            assert!(parse_size("o", bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn numbers() {
        for (text, number) in [("0.25", 0.25), ("1", 1.0), ("1e-3", 0.001_f64)] {
            assert_eq!(parse_number("o", text).unwrap().to_bits(), number.to_bits());
        }
        for bad in ["", "0", "-1", "inf", "nan", "1e-320", "0.25x", "1e999"] {
            assert!(parse_number("o", bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn packages_are_module_paths() {
        assert!(is_dotted_name("pkg.sub_mod.match"));
        for bad in ["", ".x", "a..b", "a;import os", "a b", "1a", "a\n", "a.import.b", "None", "a.True"] {
            assert!(!is_dotted_name(bad), "{bad}");
        }
    }
}
