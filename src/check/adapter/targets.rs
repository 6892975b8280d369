//! Which modules an adapter's config means, and with what rank.

use fancy_regex::Regex;
use serde_json::Value;

/// Longest regular expression of a config that is compiled.
const PATTERN_CAP: usize = 2_000;

/// `target_modules`, `r`, `rank_pattern` and the rest, as far as names and shapes follow from them.
pub(super) struct Targets<'c> {
    modules: Modules<'c>,
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
    /// `all-linear`, parameters instead of modules, or something that cannot be matched here.
    Any,
}

impl<'c> Targets<'c> {
    pub(super) fn from_config(config: &'c Value) -> Self {
        let list = |key: &str| -> Vec<&'c str> {
            config.get(key).and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str).collect()
        };
        // Parameters that are targets give their module matrices too.
        let parameters = config.get("target_parameters").is_some_and(|p| !p.is_null());
        let modules = match config.get("target_modules") {
            _ if parameters => Modules::Any,
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
            ranks,
            // PEFT's default is 8.
            rank: config.get("r").map_or(Some(8), Value::as_u64),
            dora: config.get("use_dora") == Some(&Value::Bool(true)),
            saved: list("modules_to_save"),
        }
    }

    /// Whether the config may mean this module; no only when it certainly does not.
    pub(super) fn may_cover(&self, module: &str) -> bool {
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
        !matches!(self.modules, Modules::Any) && self.may_cover(module)
    }

    /// Whether all modules have the same rank.
    pub(super) fn is_uniform(&self) -> bool {
        self.ranks.is_empty()
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
