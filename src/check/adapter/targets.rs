//! Which modules an adapter's config means, and with what rank.

use fancy_regex::Regex;
use serde_json::Value;

/// Longest regular expression of a config that is compiled.
const PATTERN_CAP: usize = 2_000;

/// `target_modules`, `r`, `rank_pattern` and the rest, as far as names and shapes follow from them.
pub(super) struct Targets<'c> {
    modules: Modules<'c>,
    /// `target_parameters`: the ends of names of parameters, whose module gets the matrices.
    parameters: Vec<&'c str>,
    /// Patterns and the rank they give, in the config's order; `None` when one cannot be compiled here.
    ranks: Vec<(Option<Regex>, Option<u64>)>,
    rank: Option<u64>,
    /// Whether weights are split into length and direction.
    pub(super) dora: bool,
    /// `modules_to_save`.
    pub(super) saved: Vec<&'c str>,
}

enum Modules<'c> {
    /// Ends of names.
    Named(Vec<&'c str>),
    /// A regular expression for the whole name.
    Regex(Regex),
    /// `all-linear`, or something that cannot be matched here.
    Any,
}

impl<'c> Targets<'c> {
    pub(super) fn from_config(config: &'c Value) -> Self {
        let list = |key: &str| -> Vec<&'c str> {
            config.get(key).and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str).collect()
        };
        let modules = match config.get("target_modules") {
            Some(Value::String(word)) if word != "all-linear" => {
                compiled(&format!("^(?:{word})$")).map_or(Modules::Any, Modules::Regex)
            }
            Some(Value::Array(_)) => Modules::Named(list("target_modules")),
            _ => Modules::Any,
        };
        let ranks = config.get("rank_pattern").and_then(Value::as_object).into_iter().flatten();
        let ranks = ranks.map(|(key, rank)| (compiled(&format!(r"^(?:.*\.)?(?:{key})$")), rank.as_u64())).collect();
        Self {
            modules,
            parameters: list("target_parameters"),
            ranks,
            // PEFT's default is 8.
            rank: config.get("r").map_or(Some(8), Value::as_u64),
            dora: config.get("use_dora") == Some(&Value::Bool(true)),
            saved: list("modules_to_save"),
        }
    }

    /// Whether the config may mean this module; no only when it certainly does not. Versions of PEFT replace some modules by
    /// parameters when they open an adapter, so none is ruled out beside parameters.
    pub(super) fn may_cover(&self, module: &str) -> bool {
        !self.parameters.is_empty() || self.may_name(module)
    }

    /// Whether `target_modules` may mean this module.
    fn may_name(&self, module: &str) -> bool {
        match &self.modules {
            Modules::Named(names) => names
                .iter()
                .any(|name| module.strip_suffix(name).is_some_and(|before| before.is_empty() || before.ends_with('.'))),
            Modules::Regex(regex) => regex.is_match(module).unwrap_or(true),
            Modules::Any => true,
        }
    }

    /// Whether the config certainly means this module.
    pub(super) fn covers(&self, module: &str) -> bool {
        self.parameters.is_empty() && self.names(module)
    }

    /// Whether `target_modules` certainly means this module.
    fn names(&self, module: &str) -> bool {
        !matches!(self.modules, Modules::Any) && self.may_name(module)
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
        self.parameters.iter().filter_map(move |target| {
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
        for (pattern, rank) in &self.ranks {
            if pattern.as_ref()?.is_match(module).ok()? {
                return *rank;
            }
        }
        self.rank
    }
}

fn compiled(pattern: &str) -> Option<Regex> {
    (pattern.len() <= PATTERN_CAP).then(|| Regex::new(pattern).ok()).flatten()
}
