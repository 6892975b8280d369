//! What the entries of a recipe name: the tensors of donors that a merge may change. Every other one keeps its bytes.

use regex::{Regex, RegexBuilder};
use regex_syntax::hir::Look;
use regex_syntax::hir::literal::Extractor;
use serde::{Deserialize, Serialize};

use super::error::MergeError;
use super::manifest::DonorTensor;
use super::parts::PartOf;
use crate::check::adapter::lora::module_of;
use crate::checkpoint::escape;
use crate::surgery::expr::{TensorExpr, TensorTransform};
use crate::surgery::plan::{Plan, PlannedTensor, TensorRef};

/// The tensors of a donor that an entry of the recipe names, and may change: those of a part, of a pattern, or of both.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct NamedTensors {
    /// Role of the donor.
    pub donor: String,
    /// The part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part: Option<String>,
    /// Starts of the names in the donor, for a part.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub starts: Vec<String>,
    /// Starts among them of names that belong to other parts.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub without: Vec<String>,
    /// Regular expression for the names in the donor; any of the part when missing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub names: Option<String>,
}

/// A type to which an entry of the recipe casts the tensors of a donor.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct AnnouncedCast {
    /// Role of the donor.
    pub donor: String,
    /// Element type, as safetensors spells it.
    pub to: String,
}

/// What a merge may change.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct Changeable {
    /// Tensors that it may fit, scale, slice or start again.
    pub named: Vec<NamedTensors>,
    /// Types to which it may cast any tensor.
    pub casts: Vec<AnnouncedCast>,
    /// Adapters that it may merge into the tensors of another donor.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub merged: Vec<MergedRoles>,
}

/// An adapter of PEFT and the model that it is merged into, by their roles.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct MergedRoles {
    /// Role of the model.
    pub base: String,
    /// Role of the adapter.
    pub adapter: String,
}

/// A donor's tensor, as a plan or a manifest names it.
pub(super) trait OfDonor {
    /// Role of the donor, and name of the tensor there.
    fn key(&self) -> (&str, &str);
    /// Its element type, as safetensors spells it.
    fn dtype(&self) -> &str;
    /// Whether it is some of the rows of a tensor.
    fn is_slice(&self) -> bool;
}

impl OfDonor for TensorRef {
    fn key(&self) -> (&str, &str) {
        (&self.donor, &self.name)
    }

    fn dtype(&self) -> &str {
        self.dtype.name()
    }

    fn is_slice(&self) -> bool {
        self.slice.is_some()
    }
}

impl OfDonor for DonorTensor {
    fn key(&self) -> (&str, &str) {
        (&self.donor, &self.name)
    }

    fn dtype(&self) -> &str {
        &self.dtype
    }

    fn is_slice(&self) -> bool {
        self.slice.is_some()
    }
}

/// Whether an expression is more than a donor's whole tensor, cast or not.
pub(super) fn is_changed<S: OfDonor>(source: &TensorExpr<S>) -> bool {
    let keeps = matches!(source.transform(), TensorTransform::Copy | TensorTransform::Convert);
    !keeps || source.scale().is_some() || source.main().is_slice()
}

/// What no entry of a recipe allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stray {
    /// A change of a tensor that none names.
    Changed,
    /// A cast that none announces.
    Cast,
}

/// Largest compiled pattern of a recipe, in bytes, and most entries with one: together some 50 MB.
const PATTERN: usize = 256 << 10;
pub(super) const MAX_ENTRIES: usize = 200;
/// Longest pattern of a recipe, and longest name that it is replaced by, in bytes.
pub(super) const MAX_PATTERN: usize = 2_000;

/// Compiles a pattern of a recipe or manifest.
///
/// # Errors
/// Why it is none: it is no regular expression, or a large one.
pub(super) fn pattern(text: &str) -> Result<Regex, String> {
    if text.len() > MAX_PATTERN {
        return Err(format!("has {} bytes, more than {MAX_PATTERN}", text.len()));
    }
    RegexBuilder::new(text).size_limit(PATTERN).build().map_err(|error| match error {
        regex::Error::CompiledTooBig(_) => format!("needs more than {PATTERN} bytes when it is compiled"),
        error => {
            let error = error.to_string();
            let cause = error.lines().last().unwrap_or_default().trim_start_matches("error: ");
            format!("is not a regular expression: {cause}")
        }
    })
}

impl NamedTensors {
    /// The tensors of an entry with a part, or with names that start with `^` and literal text; `None` for an entry that names
    /// nothing.
    pub(super) fn of_entry(donor: &str, part: Option<PartOf<'_>>, names: &str) -> Option<Self> {
        if part.is_none() && !starts_literally(names) {
            return None;
        }
        let (starts, without) = part.map(PartOf::area).unwrap_or_default();
        Some(Self {
            donor: donor.to_owned(),
            part: part.map(|part| part.name.to_owned()),
            starts,
            without,
            names: (!names.is_empty()).then(|| names.to_owned()),
        })
    }

    /// Why no recipe can have named these tensors.
    fn fault(&self) -> Option<String> {
        let names = self.names.as_deref();
        match (&self.part, names) {
            (None, None) => Some("names no tensors".to_owned()),
            (None, Some(names)) if !starts_literally(names) => {
                Some(format!("names tensors by {names:?}, which does not start with ^ and literal text"))
            }
            (_, Some(names)) => {
                pattern(names).err().map(|why| format!("names tensors by {:?}, which {why}", escape(names, 80)))
            }
            _ => None,
        }
    }
}

/// [`Changeable`] with its expressions parsed.
pub(super) struct Bounds<'c> {
    named: Vec<(&'c NamedTensors, Option<Regex>)>,
    casts: &'c [AnnouncedCast],
    merged: &'c [MergedRoles],
}

impl<'c> Bounds<'c> {
    /// The bounds of a merge.
    ///
    /// # Errors
    /// Why an entry is none that a recipe can have; one in a manifest may be anything.
    pub(super) fn new(changeable: &'c Changeable) -> Result<Self, String> {
        let entry = |named: &'c NamedTensors| {
            if let Some(fault) = named.fault() {
                return Err(format!("\"changes\" of the {} donor {fault}", named.donor));
            }
            Ok((named, named.names.as_deref().and_then(|names| pattern(names).ok())))
        };
        if changeable.named.len() > MAX_ENTRIES {
            return Err(format!("\"changes\" has {} entries, more than {MAX_ENTRIES}", changeable.named.len()));
        }
        let named = changeable.named.iter().map(entry).collect::<Result<_, _>>()?;
        Ok(Self { named, casts: &changeable.casts, merged: &changeable.merged })
    }

    /// Whether an expression may change the tensor that it stands for. A product must be that of the module of an adapter that
    /// the recipe merges.
    pub(super) fn name_source<S: OfDonor>(&self, source: &TensorExpr<S>) -> bool {
        let (donor, name) = source.main().key();
        let TensorExpr::AddProduct { to, product } = source else { return self.name(donor, name) };
        let is_of = |adapter: &str, of: &S| {
            let (role, matrix) = of.key();
            let inner = |module: &str| module.split_once('.').map(|(_, inner)| format!("{inner}.weight"));
            let is_place =
                |module: &str| name == format!("{module}.weight") || inner(module).is_some_and(|n| n == name);
            role == adapter && !of.is_slice() && module_of(matrix).is_some_and(is_place)
        };
        let is_merged = |roles: &&MergedRoles| {
            roles.base == donor
                && [&product.left, &product.right].iter().all(|factor| is_of(&roles.adapter, factor.of()))
        };
        to.copied().is_some_and(|to| !to.is_slice()) && self.merged.iter().any(|roles| is_merged(&roles))
    }

    /// Why no entry of the recipe can have made a tensor of this type so; `None` when one can.
    pub(super) fn stray<S: OfDonor>(&self, source: &TensorExpr<S>, dtype: &str) -> Option<Stray> {
        let main = source.main();
        let is_cast = main.dtype() != dtype && source.transform() != TensorTransform::Reinit;
        if is_changed(source) && !self.name_source(source) {
            return Some(Stray::Changed);
        }
        (is_cast && !self.casts_to(main.key().0, dtype)).then_some(Stray::Cast)
    }

    /// Whether a tensor of a donor may be changed.
    fn name(&self, donor: &str, tensor: &str) -> bool {
        let starts = |of: &[String]| of.iter().any(|start| tensor.starts_with(start.as_str()));
        self.named.iter().any(|(named, regex)| {
            let of_part = || named.part.is_none() || (starts(&named.starts) && !starts(&named.without));
            named.donor == donor && of_part() && regex.as_ref().is_none_or(|regex| regex.is_match(tensor))
        })
    }

    /// Whether a cast was announced.
    fn casts_to(&self, donor: &str, dtype: &str) -> bool {
        self.casts.iter().any(|cast| cast.donor == donor && cast.to == dtype)
    }

    /// Fails when a plan changes a tensor that no entry names.
    pub(super) fn hold(&self, recipe: &str, plan: &Plan) -> Result<(), MergeError> {
        let strays: Vec<&PlannedTensor> =
            plan.tensors().map(|(_, t)| t).filter(|t| self.stray(&t.source, t.dtype.name()).is_some()).collect();
        let Some(first) = strays.first() else { return Ok(()) };
        Err(MergeError::Recipe(format!(
            "{recipe}: {} of the {} donor would be changed ({}{}), and no entry that changes tensors names it by `part`, or by `names` that start with ^ and literal text; name what the entry is for",
            first.source.main().name,
            first.source.main().donor,
            first.transform().name(),
            if strays.len() > 1 { format!(", and {} more", strays.len().saturating_sub(1)) } else { String::new() },
        )))
    }
}

/// Whether every match of an expression starts at the start of the text, with at least one literal character.
pub(super) fn starts_literally(names: &str) -> bool {
    let Ok(parsed) = regex_syntax::parse(names) else { return false };
    let is_anchored = parsed.properties().look_set_prefix().contains(Look::Start);
    is_anchored && Extractor::new().extract(&parsed).min_literal_len().is_some_and(|len| len > 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pattern_names_tensors_when_it_starts_with_literal_text() {
        for names in
            ["^model\\.norm", "^(lm_head\\.weight)$", "^(?:model\\.embed_tokens|lm_head)\\.weight$", "^v.*", "\\Av"]
        {
            assert!(starts_literally(names), "{names}");
        }
        for names in
            ["", ".", "^", "^.*", "^.*norm", "norm", "^(?:a|)b?", "^(?:a|.*)", "a|^b", "(?m)^a", "^a?b*", "^\\w+", "("]
        {
            assert!(!starts_literally(names), "{names}");
        }
    }
}
