//! Quantised weights: taken out of their wrapping before the load is predicted, and checked for themselves.
//!
//! A class is compared with the plain tensors that the stored ones represent ([`Quantised::plain`]). Prefixes, renames,
//! ties and everything else a loader does to names therefore apply to quantised checkpoints unchanged. Faults of the
//! layout alone are reported for the stored tensors, with or without a known class.

mod config;
mod module;
mod shapes;
mod skipped;

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};

use super::load::Stored;
use super::load::{LoadReport, Mismatch};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::Expected;
use crate::knowledge::expression::glob;
use crate::knowledge::quantization::{AppliedScheme, DeclaredScheme, Scheme};
use module::{TensorLookup, kind};
use shapes::{ModuleShapes, ModuleState, QuantizedModule, plain_of};
use skipped::SkippedModules;

pub use config::{signature, undeclared};

/// Faults of the declared scheme and of the tensors that it covers.
#[must_use]
pub fn faults(checkpoint: &Checkpoint, declared: &DeclaredScheme<'_>, quantised: Option<&Quantised<'_>>) -> Vec<Fault> {
    let mut faults = config::disagreements(checkpoint);
    if let (DeclaredScheme::Unknown(method), Some(config)) = (declared, checkpoint.config()) {
        faults.push(config::unknown(method, config));
    }
    faults.extend(quantised.into_iter().flat_map(Quantised::faults));
    faults
}

/// The quantised modules of a checkpoint, stored by the scheme that its config declares.
pub struct Quantised<'a> {
    applied: &'a AppliedScheme<'a>,
    modules: Vec<QuantizedModule<'a>>,
    /// Kinds of module (names with their numbers taken out) of which at least one is quantised.
    kinds: BTreeSet<String>,
    skipped: SkippedModules<'a>,
    /// Parameters that would explain the shapes where those of the config do not: `bits 8`.
    fits: Option<String>,
    has_weights: bool,
}

impl<'a> Quantised<'a> {
    /// Looks at the stored tensors; plain shapes come from the class where it is known.
    #[must_use]
    pub fn new(
        applied: &'a AppliedScheme<'a>,
        expected: Option<&Expected>,
        checkpoint: &'a Checkpoint,
        stored: &'a Stored,
    ) -> Self {
        let scheme = applied.scheme();
        let tensors = TensorLookup::new(checkpoint, stored);
        let skipped = SkippedModules::new(applied, checkpoint);
        let shapes = ModuleShapes { applied, expected, skipped: &skipped };
        let found = module::group(scheme, &tensors, |name| plain_of(expected, name).is_some());
        let (mut modules, fits) = shapes.compare(found);
        let kinds = modules.iter().map(|m| kind(m.module.name)).collect();
        if applied.all_alike() {
            let quantised: BTreeSet<&str> = modules.iter().map(|m| m.module.name).collect();
            let plain = module::left_plain(scheme, &tensors, &kinds, &quantised, &skipped);
            modules.extend(plain.into_iter().map(|module| shapes.left_plain(module)));
        }
        Self { applied, modules, kinds, skipped, fits, has_weights: !stored.is_empty() }
    }

    /// The stored tensors as if they had never been quantised.
    #[must_use]
    pub fn plain(&self, stored: &Stored) -> Stored {
        let scheme = self.applied.scheme();
        let mut taken: BTreeSet<String> =
            stored.names().filter(|n| scheme.ignored.iter().any(|g| glob(n, g))).map(str::to_owned).collect();
        let mut added: BTreeMap<String, Option<Vec<u64>>> = BTreeMap::new();
        for judged in self.modules.iter().filter(|m| m.state != ModuleState::Plain) {
            let name = judged.module.name;
            let held = judged.module.endings(scheme).into_iter().map(|ending| format!("{name}{ending}"));
            // The loader takes a packed tensor of an excluded module for a plain one of that name.
            if judged.state == ModuleState::Skipped {
                let held: BTreeSet<String> = held.collect();
                taken.retain(|name| !held.contains(name));
                continue;
            }
            taken.extend(held);
            added.insert(format!("{name}{}", scheme.plain), judged.plain.clone());
        }
        stored.replacing(&taken, added)
    }

    /// Spells a report that was predicted for [`Self::plain`] tensors in the scheme's names.
    ///
    /// None for a scheme of another program that also renames what it stores: the class cannot be compared then.
    #[must_use]
    pub fn spelled(&self, mut report: LoadReport) -> Option<LoadReport> {
        let scheme = self.applied.scheme();
        // Which modules the loader leaves plain is unknown.
        if self.skipped.is_exceeded() {
            return None;
        }
        if scheme.loaded_by.is_some() && !report.unexpected.is_empty() {
            return None;
        }
        // A bias of zeros that the packer gave every module.
        let is_extra = |name: &str| {
            let module = scheme.extra.iter().find_map(|ending| name.strip_suffix(ending.as_str()));
            module.is_some_and(|module| self.kinds.contains(&kind(module)))
        };
        report.unexpected.retain(|name| !is_extra(name));
        let wrapped = |module: &&str| self.kinds.contains(&kind(module)) && !self.skipped.covers(module);
        let required = self.applied.required(&[]);
        let mut missing: BTreeSet<String> = BTreeSet::new();
        for name in std::mem::take(&mut report.missing) {
            match name.strip_suffix(scheme.plain.as_str()).filter(wrapped) {
                Some(module) => {
                    let parts = scheme.endings().zip(&required).filter(|(_, required)| **required);
                    missing.extend(parts.map(|(ending, _)| format!("{module}{ending}")));
                }
                None => drop(missing.insert(name)),
            }
        }
        // Scales without their values exist in the file, and the class knows them.
        report.unexpected.retain(|name| !missing.remove(name));
        report.missing = missing.into_iter().collect();
        Some(report)
    }

    /// Adds the keys that the loader reports for modules that do not follow the scheme.
    ///
    /// Separate from [`Self::spelled`], because [`Self::faults`] reports these modules already.
    pub fn complete(&self, report: &mut LoadReport) {
        let scheme = self.applied.scheme();
        for judged in self.modules.iter().filter(|m| m.state != ModuleState::Skipped) {
            let name = judged.module.name;
            report.missing.extend(judged.lacks(scheme).map(|ending| format!("{name}{ending}")));
            if judged.state == ModuleState::Plain && !scheme.keeps_name() {
                report.unexpected.push(format!("{name}{}", scheme.plain));
            }
            let misshapen = judged.misshapen(scheme).filter(|_| judged.of_class);
            report.mismatched.extend(misshapen.map(|(ending, stored, expected)| Mismatch {
                name: format!("{name}{ending}"),
                stored: stored.to_vec(),
                expected: expected.to_vec(),
            }));
        }
        report.missing.sort();
        report.unexpected.sort();
        report.mismatched.sort_by(|a, b| a.name.cmp(&b.name));
        if let (Some(raises), Some(judged)) = (&scheme.raises, self.incomplete().next()) {
            let tensor = format!("{}{}", judged.module.name, scheme.plain);
            report.raises.get_or_insert_with(|| raises.replace("{tensor}", &tensor));
        }
    }

    /// Faults of the wrapping, one for each module and cause.
    fn faults(&self) -> Vec<Fault> {
        let scheme = self.applied.scheme();
        let mut faults = Vec::new();
        if self.skipped.is_exceeded() {
            let at = Place::file(files::CONFIG).pointer(self.applied.pointer());
            return vec![Fault::new(FaultKind::PatternsNotCompared).at(at)];
        }
        if let Some(program) = &scheme.loaded_by {
            let at = Place::file(files::CONFIG).pointer("/quantization");
            let fault = Fault::new(FaultKind::QuantizedForAnotherLoader).at(at).with("scheme", scheme.summary.as_str());
            faults.push(fault.with("program", program.as_str()));
        }
        if self.modules.is_empty() && self.has_weights && !scheme.plain_too {
            let at = Place::file(files::CONFIG).pointer(self.applied.pointer());
            faults.push(
                Fault::new(FaultKind::QuantizedConfigPlainTensors).at(at).with("scheme", scheme.summary.as_str()),
            );
        }
        for judged in &self.modules {
            let name = judged.module.name;
            let tensor = |ending: &str| format!("{name}{ending}");
            let fault = |kind| Fault::new(kind).with("scheme", scheme.summary.as_str()).with("module", name);
            match judged.state {
                ModuleState::Skipped => {
                    let carrier = scheme.endings().next().unwrap_or_default();
                    faults.push(fault(FaultKind::QuantizedThoughSkipped).at(Place::tensor(tensor(carrier))));
                }
                ModuleState::Plain => {
                    faults.push(fault(FaultKind::PlainThoughQuantized).at(Place::tensor(tensor(&scheme.plain))));
                }
                ModuleState::Quantised => {
                    let lacks: Vec<&str> = judged.lacks(scheme).collect();
                    if !lacks.is_empty() {
                        let carrier = scheme.endings().next().unwrap_or_default();
                        let names: Vec<String> = lacks.iter().map(|ending| tensor(ending)).collect();
                        let at = Place::tensor(tensor(carrier));
                        faults.push(fault(FaultKind::QuantizedModuleIncomplete).at(at).with("lacks", names));
                    }
                    faults.extend(judged.misshapen(scheme).map(|(ending, stored, expected)| {
                        let at = Place::tensor(tensor(ending));
                        let fault = fault(FaultKind::QuantizedShapeWrong).at(at).with("stored", stored.to_vec());
                        fault.with("expected", expected.to_vec()).with("fits", self.fits.as_deref().unwrap_or_default())
                    }));
                    faults.extend(mistyped(scheme, judged).map(|(ending, dtype, allowed)| {
                        let at = Place::tensor(tensor(ending));
                        fault(FaultKind::QuantizedDtypeWrong).at(at).with("dtype", dtype).with("allowed", allowed)
                    }));
                }
            }
        }
        faults
    }

    /// Modules of which the loader does not find all it needs.
    fn incomplete(&self) -> impl Iterator<Item = &QuantizedModule<'a>> {
        let scheme = self.applied.scheme();
        self.modules.iter().filter(move |m| m.state != ModuleState::Skipped && m.lacks(scheme).next().is_some())
    }
}

/// Tensors of a module with an element type that the scheme does not write: ending, type, allowed types.
fn mistyped<'s>(
    scheme: &'s Scheme,
    judged: &'s QuantizedModule<'_>,
) -> impl Iterator<Item = (&'s str, &'static str, String)> {
    scheme.tensors.iter().zip(&judged.module.held).filter_map(|(part, held)| {
        let dtype = held.as_ref()?.dtype?.name();
        let allowed = part.dtypes.iter().any(|d| d == dtype);
        (!allowed).then(|| (part.name.as_str(), dtype, part.dtypes.join(" or ")))
    })
}

#[cfg(test)]
mod tests;
