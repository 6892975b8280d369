//! What the entries of a recipe name: the tensors of donors that a merge may change. Every other one keeps its bytes.

use std::cell::RefCell;

use regex::{Regex, RegexBuilder};
use regex_automata::nfa::thompson;
use regex_syntax::hir::Look;
use regex_syntax::hir::literal::Extractor;
use serde::{Deserialize, Serialize};

use super::donor_tensor::DonorTensor;
use super::error::MergeError;
use super::parts::PartOf;
use crate::check::adapter::lora::module_of;
use crate::checkpoint::escape;
use crate::checkpoint::work::Work;
use crate::surgery::expr::{TensorExpr, TensorTransform};
use crate::surgery::plan::Plan;
use crate::surgery::planned_tensor::PlannedTensor;
use crate::surgery::tensor_ref::TensorRef;

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

/// Work of a comparison with a donor's role or the start of a name.
const COMPARISON: u64 = 20;

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
    named: Vec<(&'c NamedTensors, Option<Pattern>)>,
    casts: &'c [AnnouncedCast],
    merged: &'c [MergedRoles],
    /// What comparisons may cost, for bounds that a stranger wrote.
    work: Option<RefCell<Work>>,
}

/// An expression, and the most states that a search of it may be in at one byte.
struct Pattern {
    regex: Regex,
    states: u64,
}

impl Pattern {
    fn new(text: &str) -> Option<Self> {
        let states = thompson::NFA::compiler().build(text).map_or(PATTERN, |nfa| nfa.states().len());
        Some(Self { regex: pattern(text).ok()?, states: u64::try_from(states).unwrap_or(u64::MAX) })
    }
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
            Ok((named, named.names.as_deref().and_then(Pattern::new)))
        };
        if changeable.named.len() > MAX_ENTRIES {
            return Err(format!("\"changes\" has {} entries, more than {MAX_ENTRIES}", changeable.named.len()));
        }
        let named = changeable.named.iter().map(entry).collect::<Result<_, _>>()?;
        Ok(Self { named, casts: &changeable.casts, merged: &changeable.merged, work: None })
    }

    /// The same bounds, whose comparisons may cost what `bytes` bytes may. Called by `verify` with those of a manifest.
    pub(super) fn paid_by(self, bytes: u64) -> Self {
        Self { work: Some(RefCell::new(Work::for_bytes(bytes))), ..self }
    }

    /// Whether comparisons cost more than they may. From then on, everything counts as allowed.
    pub(super) fn is_exceeded(&self) -> bool {
        !self.pay(1, 1)
    }

    /// Pays for `count` comparisons of `units` each; false when more is asked for than is left.
    fn pay(&self, count: usize, units: u64) -> bool {
        self.work.as_ref().is_none_or(|work| work.borrow_mut().spend(count, units).is_ok())
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
        if !self.pay(self.merged.len(), COMPARISON) {
            return true;
        }
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
        self.named.iter().any(|(named, pattern)| {
            let of_part = || {
                let list = named.starts.len().saturating_add(named.without.len());
                named.part.is_none()
                    || !self.pay(list, COMPARISON)
                    || (starts(&named.starts) && !starts(&named.without))
            };
            let has_name =
                |pattern: &Pattern| !self.pay(tensor.len(), pattern.states) || pattern.regex.is_match(tensor);
            !self.pay(1, COMPARISON) || named.donor == donor && of_part() && pattern.as_ref().is_none_or(has_name)
        })
    }

    /// Whether a cast was announced.
    fn casts_to(&self, donor: &str, dtype: &str) -> bool {
        !self.pay(self.casts.len(), COMPARISON) || self.casts.iter().any(|cast| cast.donor == donor && cast.to == dtype)
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

    /// Patterns with hundreds of states, or a million starts of names for each tensor.
    #[test]
    fn bounds_of_a_stranger_cost_what_their_bytes_may() {
        let named = |starts: usize, names: &str| NamedTensors {
            donor: "vision".to_owned(),
            part: (starts > 0).then(|| "projector".to_owned()),
            starts: vec!["x".to_owned(); starts],
            without: Vec::new(),
            names: (!names.is_empty()).then(|| names.to_owned()),
        };
        for (entry, entries, is_exceeded) in [
            (named(0, "^m(?:[a-z]{40}){10}x"), 200, true),
            (named(1_000_000, ""), 1, true),
            (named(1, "^model\\.layers\\.[0-9]+\\.mlp"), 20, false),
        ] {
            let changeable = Changeable { named: vec![entry; entries], casts: Vec::new(), merged: Vec::new() };
            let names: Vec<String> = (0..2_000).map(|i| format!("model.layers.{i}.self_attn.q_proj.weight")).collect();
            let bounds = Bounds::new(&changeable).expect("bounds").paid_by(100 * 2_000);
            let allowed = names.iter().filter(|name| bounds.name("vision", name)).count();
            assert_eq!((bounds.is_exceeded(), allowed > 0), (is_exceeded, is_exceeded));
        }
    }

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
