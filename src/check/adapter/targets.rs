//! Which modules an adapter's config means, and with what rank.

use std::cell::{Cell, RefCell};
use std::collections::HashSet;

use serde_json::Value;

use crate::check::config_pattern::{COMPARISON, ConfigPattern, allowance};
use crate::checkpoint::files;
use crate::checkpoint::work::{Work, WorkExceeded};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};

/// `target_modules`, `r`, `rank_pattern` and the rest, as far as names and shapes follow from them, within the work that the
/// size of the adapter allows. After that, nothing follows.
pub(super) struct Targets<'c> {
    modules: Modules<'c>,
    /// `target_parameters`: the ends of names of parameters, whose module gets the matrices.
    parameters: Vec<&'c str>,
    /// Patterns and the rank they give, in the config's order; `None` when one cannot be compiled here.
    ranks: Vec<(Option<ConfigPattern>, Option<u64>)>,
    rank: Option<u64>,
    /// The same for `lora_alpha`.
    alphas: Vec<(Option<ConfigPattern>, Option<f64>)>,
    alpha: Option<f64>,
    /// Whether weights are split into length and direction.
    pub(super) dora: bool,
    /// `modules_to_save`.
    pub(super) saved: Vec<&'c str>,
    work: RefCell<Work>,
    exceeded: Cell<bool>,
}

enum Modules<'c> {
    /// Ends of names.
    Named(HashSet<&'c str>),
    /// A regular expression for the whole name.
    Pattern(ConfigPattern),
    /// `all-linear`, or something that cannot be matched here.
    Any,
}

impl<'c> Targets<'c> {
    /// What the config says; a `part` of the work that the size of the adapter allows may be spent on it.
    pub(super) fn from_config(config: &'c Value, checkpoint: &Checkpoint, part: u64) -> Self {
        let list = |key: &str| -> Vec<&'c str> {
            config.get(key).and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str).collect()
        };
        let mut work = allowance(checkpoint, checkpoint.document(files::ADAPTER_CONFIG)).part(part);
        let mut exceeded = false;
        let mut compiled = |text: &str| {
            if exceeded {
                return None;
            }
            ConfigPattern::compile(text, &mut work).unwrap_or_else(|WorkExceeded| {
                exceeded = true;
                None
            })
        };
        let modules = match config.get("target_modules") {
            Some(Value::String(word)) if word != "all-linear" => {
                compiled(&format!("(?:{word})$")).map_or(Modules::Any, Modules::Pattern)
            }
            Some(Value::Array(_)) => Modules::Named(list("target_modules").into_iter().collect()),
            _ => Modules::Any,
        };
        let patterns = |key: &str| config.get(key).and_then(Value::as_object).into_iter().flatten();
        let mut end_of_name = |key: &str| compiled(&format!(r"(?:.*\.)?(?:{key})$"));
        let ranks = patterns("rank_pattern").map(|(key, rank)| (end_of_name(key), rank.as_u64())).collect();
        let alphas = patterns("alpha_pattern").map(|(key, alpha)| (end_of_name(key), alpha.as_f64())).collect();
        Self {
            modules,
            parameters: list("target_parameters"),
            ranks,
            // PEFT's default of both is 8.
            rank: config.get("r").map_or(Some(8), Value::as_u64),
            alphas,
            alpha: config.get("lora_alpha").map_or(Some(8.0), Value::as_f64),
            dora: config.get("use_dora") == Some(&Value::Bool(true)),
            saved: list("modules_to_save"),
            work: RefCell::new(work),
            exceeded: Cell::new(exceeded),
        }
    }

    /// Adds the work for the names of a base model.
    pub(super) fn grant(&self, bytes: usize) {
        self.work.borrow_mut().grant(u64::try_from(bytes).unwrap_or(u64::MAX));
    }

    /// The fault of lists and patterns that would cost more to compare than the size of the adapter explains.
    pub(super) fn excess(&self) -> Option<Fault> {
        self.exceeded.get().then(|| Fault::new(FaultKind::PatternsNotCompared).at(Place::file(files::ADAPTER_CONFIG)))
    }

    /// Pays for `count` comparisons of `units` each; whether they may be made.
    pub(super) fn affords(&self, count: usize, units: usize) -> bool {
        let units = COMPARISON.saturating_add(u64::try_from(units).unwrap_or(u64::MAX));
        let paid = !self.exceeded.get() && self.work.borrow_mut().spend(count, units).is_ok();
        self.exceeded.set(!paid);
        paid
    }

    /// Whether a pattern matches; `None` when that cannot be said here.
    fn matches(&self, pattern: &ConfigPattern, name: &str) -> Option<bool> {
        let found = pattern.matches(name, &mut self.work.borrow_mut());
        if found.is_err() {
            self.exceeded.set(true);
        }
        found.ok().flatten()
    }

    /// Whether the config may mean this module; no only when it certainly does not. Versions of PEFT replace some modules by
    /// parameters when they open an adapter, so none is ruled out beside parameters.
    pub(super) fn may_cover(&self, module: &str) -> bool {
        !self.parameters.is_empty() || self.may_name(module) != Some(false)
    }

    /// Whether `target_modules` means this module; `None` when that cannot be said here.
    pub(super) fn may_name(&self, module: &str) -> Option<bool> {
        match &self.modules {
            Modules::Named(names) => {
                let mut ends = module.match_indices('.').filter_map(|(dot, _)| module.get(dot.saturating_add(1)..));
                self.affords(1, module.len().saturating_mul(4))
                    .then(|| names.contains(module) || ends.any(|end| names.contains(end)))
            }
            Modules::Pattern(pattern) => self.matches(pattern, module),
            Modules::Any => None,
        }
    }

    /// The names in a list of `target_modules`.
    pub(super) fn named(&self) -> impl Iterator<Item = &'c str> {
        let names = match &self.modules {
            Modules::Named(names) => Some(names),
            Modules::Pattern(_) | Modules::Any => None,
        };
        names.into_iter().flatten().copied()
    }

    /// Whether the config certainly means this module.
    pub(super) fn covers(&self, module: &str) -> bool {
        self.parameters.is_empty() && self.names(module)
    }

    /// Whether `target_modules` certainly means this module.
    fn names(&self, module: &str) -> bool {
        self.may_name(module) == Some(true)
    }

    /// Whether all modules have the same rank: not with matrices of parameters, which have a rank for each expert.
    pub(super) fn is_uniform(&self) -> bool {
        self.ranks.is_empty() && self.parameters.is_empty()
    }

    /// The parameters of a module that `target_parameters` may mean, by their whole names, with the rank of each; empty when
    /// the matrices are those of the module itself.
    ///
    /// PEFT wraps the module once for each parameter, in the order of their names: the matrices of the first one are in the
    /// innermost wrapper, `base_layer.base_layer` and so on. Source: peft 0.21.2, `_inject_parameters` and `ParamWrapper`.
    pub(super) fn parameters<'t>(
        &'t self,
        module: &'t str,
    ) -> impl Iterator<Item = (String, Option<u64>)> + use<'t, 'c> {
        let holder = module.split(".base_layer").next().unwrap_or(module);
        let is_named = self.names(module);
        let longest = self.parameters.iter().map(|target| target.len()).max().unwrap_or(0);
        let count = if self.affords(self.parameters.len(), longest) { self.parameters.len() } else { 0 };
        self.parameters.iter().take(count).filter_map(move |target| {
            let (place, leaf) = target.rsplit_once('.').unwrap_or(("", target));
            let before = holder.strip_suffix(place)?;
            let is_meant = if place.is_empty() { !is_named } else { before.is_empty() || before.ends_with('.') };
            let name = format!("{holder}.{leaf}");
            let rank = self.rank(&name);
            is_meant.then_some((name, rank))
        })
    }

    /// The rank of a module, when it follows from the config.
    pub(super) fn rank(&self, module: &str) -> Option<u64> {
        self.of_pattern(&self.ranks, self.rank, module)
    }

    /// The `lora_alpha` of a module, when it follows from the config.
    pub(super) fn alpha(&self, module: &str) -> Option<f64> {
        self.of_pattern(&self.alphas, self.alpha, module)
    }

    /// The value of the first pattern that matches a module, or the one without a pattern.
    fn of_pattern<T: Copy>(
        &self,
        patterns: &[(Option<ConfigPattern>, Option<T>)],
        otherwise: Option<T>,
        module: &str,
    ) -> Option<T> {
        for (pattern, value) in patterns {
            if self.matches(pattern.as_ref()?, module)? {
                return *value;
            }
        }
        otherwise.filter(|_| !self.exceeded.get())
    }
}
