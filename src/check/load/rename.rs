//! Renamings of transformers 5: one `WeightTransform` of its `core_model_loading.py`, applied to one name.

use std::cell::OnceCell;

use super::pattern::{Pattern, contained};
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
    pattern: Pattern,
    /// Number of the group of each branch, by the branch.
    groups: Vec<(usize, usize)>,
}

impl Branches {
    fn new(row: &Conversion) -> Option<Self> {
        let mut branches: Vec<(usize, &String)> = row.from.iter().enumerate().collect();
        // A name is matched by the first branch that fits, so the longest stands first.
        branches.sort_by_key(|(_, text)| std::cmp::Reverse(text.chars().count()));
        let branches: Vec<String> = branches.into_iter().map(|(i, text)| branch(i, text)).collect();
        let pattern = Pattern::new(&branches.join("|"))?;
        let groups = (0..row.from.len()).filter_map(|i| Some((i, pattern.group(&format!("g{i}"))?))).collect();
        Some(Self { pattern, groups })
    }
}

/// A transform, ready to be asked.
pub(super) struct Transform<'c> {
    row: &'c Conversion,
    /// For each branch a text that every match contains: most models have no name with any of them, and compiling a pattern
    /// takes as long as a hundred searches. `None` where a branch has no such text.
    contained: Option<Vec<String>>,
    /// `None` when the pattern does not compile.
    branches: OnceCell<Option<Branches>>,
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
        let contained = row.from.iter().map(|text| contained(&glob(text))).collect();
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
        if self.contained.as_ref().is_some_and(|texts| !texts.iter().any(|text| inner.contains(text))) {
            return None;
        }
        let branches = self.branches.get_or_init(|| Branches::new(self.row)).as_ref()?;
        let captures = branches.pattern.captures(inner)?;
        let (branch, at) = *branches.groups.iter().find(|(_, at)| captures.range(*at).is_some())?;
        let inside = |n: usize| captures.text(at.saturating_add(n));
        let replacement = match &mut self.target {
            Target::First => self.row.to.first()?.replace(r"\1", inside(1)),
            Target::Offset(offset) => {
                let index = inside(1).parse::<u64>().ok()?.checked_add(*offset)?;
                self.row.to.first()?.replace(r"\1", &index.to_string())
            }
            Target::Own { active } => {
                *active |= branch == 0;
                if !*active {
                    return None;
                }
                (1..10).fold(self.row.to.get(branch)?.clone(), |text, n| text.replace(&format!(r"\{n}"), inside(n)))
            }
        };
        let matched = captures.text(0);
        // As the loader does: the first place where the matched text stands, which need not be where it matched.
        let renamed = inner.replacen(matched, &replacement, 1);
        Some((format!("{prefix}{renamed}"), self.row.from.get(branch)?))
    }
}

/// A source pattern as a regular expression: `*.` is a glob.
fn glob(text: &str) -> String {
    text.replace("*.", r".*\.")
}

/// A source pattern as one branch of the transform's pattern: a name ends where the pattern does.
fn branch(i: usize, text: &str) -> String {
    let glob = glob(text);
    let ends_a_name = glob.ends_with(|c: char| c.is_ascii_alphanumeric());
    format!("(?P<g{i}>{glob}{})", if ends_a_name { r"(?!\w)" } else { "" })
}
