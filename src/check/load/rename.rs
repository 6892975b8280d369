//! Renamings of transformers 5: one `WeightTransform` of its `core_model_loading.py`, applied to one name.

use std::cell::OnceCell;

use memchr::memmem::Finder;

use super::pattern::{Pattern, Simple, contained};
use crate::knowledge::Conversion;

/// What a transform replaces the matched text with.
enum Target {
    /// The first target pattern, with the matched branch's group in it.
    First,
    /// The target of the matched branch, once the first branch has been seen (`GroupWeightRename`).
    Own {
        /// Whether the first branch has matched a name.
        active: bool,
    },
    /// The first target pattern, the group being a number this much larger (`Inkling2IndexOffsetWeightRename`).
    Offset(u64),
}

/// The source patterns of a row.
struct Branches {
    /// Each branch with its index, in the order in which they are tried, for plain names; `None` where one of them needs a
    /// regular expression.
    simple: Option<Vec<(usize, Simple)>>,
    row: Vec<String>,
    /// `None` when the pattern does not compile.
    regular: OnceCell<Option<Regular>>,
}

/// The branches as one regular expression.
struct Regular {
    pattern: Pattern,
    /// Number of the group of each branch, by the branch.
    groups: Vec<(usize, usize)>,
}

/// Where one of the branches matched.
struct Matched<'n> {
    branch: usize,
    text: &'n str,
    /// The groups in the branch.
    inside: Vec<&'n str>,
}

impl Branches {
    fn new(row: &Conversion) -> Self {
        let mut branches: Vec<(usize, String)> = row.from.iter().map(|text| branch(text)).enumerate().collect();
        // A name is matched by the first branch that fits, so the longest stands first.
        branches.sort_by_key(|(i, _)| std::cmp::Reverse(row.from.get(*i).map_or(0, |text| text.chars().count())));
        let simple = branches.iter().map(|(i, text)| Some((*i, Simple::new(text)?))).collect();
        let row = branches.into_iter().map(|(i, text)| format!("(?P<g{i}>{text})")).collect();
        Self { simple, row, regular: OnceCell::new() }
    }

    fn regular(&self) -> Option<&Regular> {
        let compile = || {
            let pattern = Pattern::new(&self.row.join("|"))?;
            let groups = (0..self.row.len()).filter_map(|i| Some((i, pattern.group(&format!("g{i}"))?))).collect();
            Some(Regular { pattern, groups })
        };
        self.regular.get_or_init(compile).as_ref()
    }

    fn find<'n>(&self, name: &'n str) -> Option<Matched<'n>> {
        if let Some(simple) = self.simple.as_ref().filter(|_| Simple::reads(name)) {
            let found = simple.iter().filter_map(|(branch, simple)| Some((*branch, simple.find(name)?)));
            let (branch, range) = found.min_by_key(|(_, range)| range.start)?;
            return Some(Matched { branch, text: name.get(range)?, inside: Vec::new() });
        }
        let Regular { pattern, groups } = self.regular()?;
        let captures = pattern.captures(name)?;
        let (branch, at) = *groups.iter().find(|(_, at)| captures.range(*at).is_some())?;
        let inside = (1..10).map(|n| captures.text(at.saturating_add(n))).collect();
        Some(Matched { branch, text: captures.text(0), inside })
    }
}

/// A transform, ready to be asked.
pub(super) struct Transform<'c> {
    row: &'c Conversion,
    /// For each branch a text that every match contains: most models have no name with any of them, and compiling a pattern
    /// takes as long as a hundred searches. `None` where a branch has no such text.
    contained: Option<Vec<Finder<'static>>>,
    branches: OnceCell<Branches>,
    target: Target,
    /// What a name has to start with, the longer first; none for a transform of the whole model.
    prefixes: Option<[String; 2]>,
}

impl<'c> Transform<'c> {
    pub(super) fn new(row: &'c Conversion, base_model_prefix: &str) -> Self {
        let target = match row.kind.as_str() {
            "GroupWeightRename" => Target::Own { active: false },
            "Inkling2IndexOffsetWeightRename" => {
                Target::Offset(row.extra.get("offset").and_then(serde_json::Value::as_u64).unwrap_or(1))
            }
            _ => Target::First,
        };
        let dotted = |text: &str| if text.is_empty() { String::new() } else { format!("{text}.") };
        let prefixes = row.scope.as_ref().map(|scope| {
            let scope = dotted(scope);
            [format!("{}{scope}", dotted(base_model_prefix)), scope]
        });
        let contained = row.from.iter().map(|text| Some(Finder::new(&contained(&glob(text))?).into_owned())).collect();
        Self { row, contained, branches: OnceCell::new(), target, prefixes }
    }

    pub(super) const fn row(&self) -> &'c Conversion {
        self.row
    }

    pub(super) fn is_converter(&self) -> bool {
        self.row.kind == "WeightConverter"
    }

    /// The new name and the source pattern that matched; `None` when none does.
    pub(super) fn apply(&mut self, name: &str) -> Option<(String, &'c str)> {
        let (prefix, inner) = match &self.prefixes {
            None => ("", name),
            Some(prefixes) => prefixes.iter().find_map(|p| Some((p.as_str(), name.strip_prefix(p.as_str())?)))?,
        };
        if self.contained.as_ref().is_some_and(|texts| !texts.iter().any(|text| text.find(inner.as_bytes()).is_some()))
        {
            return None;
        }
        let Matched { branch, text, inside } = self.branches.get_or_init(|| Branches::new(self.row)).find(inner)?;
        let inside = |n: usize| inside.get(n.saturating_sub(1)).copied().unwrap_or_default();
        let replacement = match &mut self.target {
            Target::First => replaced(self.row.to.first()?, 1, inside(1)),
            Target::Offset(offset) => {
                let index = inside(1).parse::<u64>().ok()?.checked_add(*offset)?;
                replaced(self.row.to.first()?, 1, &index.to_string())
            }
            Target::Own { active } => {
                *active |= branch == 0;
                if !*active {
                    return None;
                }
                (1..10).fold(self.row.to.get(branch)?.clone(), |text, n| replaced(&text, n, inside(n)))
            }
        };
        // As the loader does: the first place where the matched text stands, which need not be where it matched.
        let mut places = inner.as_bytes().windows(text.len().max(1));
        let at = if text.is_empty() { 0 } else { places.position(|place| place == text.as_bytes())? };
        let (before, after) = (inner.get(..at)?, inner.get(at.saturating_add(text.len())..)?);
        Some(([prefix, before, &replacement, after].concat(), self.row.from.get(branch)?))
    }
}

/// A target pattern with the text of its `n`th group.
fn replaced(to: &str, n: usize, text: &str) -> String {
    if to.contains('\\') { to.replace(&format!(r"\{n}"), text) } else { to.to_owned() }
}

/// A source pattern as a regular expression: `*.` is a glob.
fn glob(text: &str) -> String {
    text.replace("*.", r".*\.")
}

/// A source pattern as one branch of the transform's pattern: a name ends where the pattern does.
fn branch(text: &str) -> String {
    let mut glob = glob(text);
    if glob.ends_with(|c: char| c.is_ascii_alphanumeric()) {
        glob.push_str(super::pattern::NAME_ENDS);
    }
    glob
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// Every branch that is matched without a regular expression matches as its regular expression does.
    #[test]
    fn simple_branches_match_as_regular_ones() {
        let names = [
            "model.layers.0.mlp.experts.10.gate_proj.weight",
            "mlp.experts.1.up_proj.weight_scale",
            "mlp.experts.down_proj.weight",
            "xmlp-experts.3.down_proj.weight.down_proj.weight",
            "mlp.experts.3.down_proj.weights",
            "a.gamma",
            "gamma",
            "",
        ];
        let rows: [(&[&str], bool); 6] = [
            (&["mlp.experts.*.gate_proj.weight", "mlp.experts.*.up_proj.weight"], true),
            (&["mlp.experts.*.down_proj.weight"], true),
            (&["^model", "gamma", "^a.gam"], true),
            (&[r"\.gamma", "mlp", ".experts."], true),
            (&[r"layers.(\d+).mlp", "gamma"], false),
            (&["a.*b.*c"], false),
        ];
        for (from, is_simple) in rows {
            let row: Conversion = serde_json::from_value(json!({ "kind": "", "from": from, "to": [] })).expect("a row");
            let both = Branches::new(&row);
            assert_eq!(both.simple.is_some(), is_simple, "{from:?}");
            let regular = Branches { simple: None, ..Branches::new(&row) };
            for name in names {
                let of = |branches: &Branches| branches.find(name).map(|found| (found.branch, found.text.to_owned()));
                assert_eq!(of(&both), of(&regular), "{from:?} {name}");
            }
        }
    }
}
