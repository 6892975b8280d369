//! The tree of modules: the parts of tensor names between dots, with repeated modules on one line.

use serde::Serialize;

use super::Amount;
use super::tensors::in_order;
use crate::checkpoint::{Checkpoint, Tensor};

/// Parts into which a name is divided at most; the last is the rest of the name.
const PARTS: usize = 24;

/// A module of a checkpoint, or a run of modules that differ only in their consecutive numbers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct InspectedModule {
    /// Its whole name; that of the first module of a run.
    pub name: String,
    /// The whole name of the last module of a run; missing for one module.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last: Option<String>,
    /// Number of modules in the run; 1 for one module.
    pub repeats: u64,
    /// The tensors inside, of all modules of the run together.
    #[serde(flatten)]
    pub amount: Amount,
    /// Bytes by the values of the properties of a [`ModuleMap`](super::ModuleMap), in their order; empty without a map.
    #[serde(skip)]
    pub shares: Vec<u64>,
    /// The modules inside, and the tensors beside these. Empty for a module that has only tensors, and for a tensor.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub modules: Vec<Self>,
}

/// Adds the bytes of a tensor to the shares of a module.
pub(super) type AddShares<'s> = &'s dyn Fn(&Tensor, &mut Vec<u64>);

impl InspectedModule {
    /// Adds the amounts of a module with the same tensors inside.
    fn absorb(&mut self, other: &Self) {
        self.amount.merge(other.amount);
        for (own, other) in self.shares.iter_mut().zip(&other.shares) {
            *own = own.saturating_add(*other);
        }
        for (own, other) in self.modules.iter_mut().zip(&other.modules) {
            own.absorb(other);
        }
    }
}

/// The modules of a checkpoint, in the order of their names. A module that has one module and nothing else is joined with it.
pub(super) fn of(checkpoint: &Checkpoint, add: AddShares<'_>) -> Vec<InspectedModule> {
    let mut sorted: Vec<&Tensor> = checkpoint.tensors().map(|(_, tensor)| tensor).collect();
    sorted.sort_by(|a, b| in_order(&a.name, &b.name));
    modules(&sorted, 0, 1, add)
}

/// The modules at one level of the tree: `outer` bytes of the names are those of the module around them and its dot.
fn modules(tensors: &[&Tensor], outer: usize, level: usize, add: AddShares<'_>) -> Vec<InspectedModule> {
    if level > 1 && tensors.iter().all(|tensor| split(tensor, outer, level).1.is_none()) {
        return Vec::new();
    }
    let mut runs: Vec<Run<'_, '_>> = Vec::new();
    for group in tensors.chunk_by(|a, b| part(a, outer, level) == part(b, outer, level)) {
        let name = group.first().map(|tensor| part(tensor, outer, level)).unwrap_or_default();
        let end = outer.saturating_add(name.len());
        let one = Group { tensors: group, end, number: number(name) };
        match runs.last_mut().filter(|run| run.continues(&one)) {
            Some(run) => run.0.push(one),
            None => runs.push(Run(vec![one])),
        }
    }
    runs.iter().filter_map(|run| run.module(level, add)).collect()
}

/// The part of a name at a level, and what follows its dot.
fn split(tensor: &Tensor, outer: usize, level: usize) -> (&str, Option<&str>) {
    let rest = tensor.name.get(outer..).unwrap_or_default();
    match rest.split_once('.').filter(|_| level < PARTS) {
        Some((part, inner)) => (part, Some(inner)),
        None => (rest, None),
    }
}

fn part(tensor: &Tensor, outer: usize, level: usize) -> &str {
    split(tensor, outer, level).0
}

/// The number that a part is. `007`, and numbers beyond u64, are words.
fn number(part: &str) -> Option<u64> {
    part.parse().ok().filter(|n: &u64| n.to_string() == part)
}

/// The tensors of one module, or one tensor.
struct Group<'g, 't> {
    tensors: &'g [&'t Tensor],
    /// Bytes in the name of the module.
    end: usize,
    number: Option<u64>,
}

impl Group<'_, '_> {
    fn name(&self) -> String {
        self.tensors.first().and_then(|tensor| tensor.name.get(..self.end)).unwrap_or_default().to_owned()
    }

    /// Whether two modules have tensors of the same names, dtypes and shapes.
    fn is_like(&self, other: &Self) -> bool {
        let alike = |(a, b): (&&Tensor, &&Tensor)| {
            a.name.get(self.end..) == b.name.get(other.end..) && (a.dtype, &a.shape) == (b.dtype, &b.shape)
        };
        self.tensors.len() == other.tensors.len() && self.tensors.iter().zip(other.tensors).all(alike)
    }

    fn module(&self, level: usize, add: AddShares<'_>) -> InspectedModule {
        let (mut amount, mut shares) = (Amount::default(), Vec::new());
        for tensor in self.tensors {
            amount.add(tensor);
            add(tensor, &mut shares);
        }
        // A tensor that has the name of the module is first.
        let own = self.tensors.iter().take_while(|tensor| tensor.name.len() <= self.end).count();
        let inner = self.tensors.get(own..).unwrap_or_default();
        let modules = modules(inner, self.end.saturating_add(1), level.saturating_add(1), add);
        InspectedModule { name: self.name(), last: None, repeats: 1, amount, shares, modules }
    }
}

/// Modules with consecutive numbers and the same tensors, or one module.
struct Run<'g, 't>(Vec<Group<'g, 't>>);

impl Run<'_, '_> {
    fn continues(&self, next: &Group<'_, '_>) -> bool {
        let follows =
            |last: &Group<'_, '_>| next.number.is_some() && last.number.and_then(|n| n.checked_add(1)) == next.number;
        self.0.last().is_some_and(|last| follows(last) && last.is_like(next))
    }

    fn module(&self, level: usize, add: AddShares<'_>) -> Option<InspectedModule> {
        let (first, others) = self.0.split_first()?;
        let mut module = first.module(level, add);
        for other in others {
            module.absorb(&other.module(level, add));
            module.repeats = module.repeats.saturating_add(1);
        }
        module.last = others.last().map(Group::name);
        match module.modules.as_slice() {
            [one] if others.is_empty() && one.amount == module.amount => module.modules.pop(),
            _ => Some(module),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{InspectedModule, Tensor, in_order, modules};
    use crate::checkpoint::Dtype;

    fn lines(modules: &[InspectedModule], indent: &str, out: &mut Vec<String>) {
        for one in modules {
            let last = one.last.as_deref().map(|last| format!(" to {last} ({})", one.repeats)).unwrap_or_default();
            out.push(format!("{indent}{}{last}: {}", one.name, one.amount.tensors));
            lines(&one.modules, &format!("{indent} "), out);
        }
    }

    /// The tree of tensors with these names; one that ends with `!` has another shape.
    fn shown(names: &[&str]) -> Vec<String> {
        let tensor = |name: &&str| Tensor {
            name: name.trim_end_matches('!').to_owned(),
            dtype: Dtype::F32,
            shape: if name.ends_with('!') { vec![2] } else { vec![1] },
            begin: 0,
            end: 4,
        };
        let tensors: Vec<Tensor> = names.iter().map(tensor).collect();
        let mut sorted: Vec<&Tensor> = tensors.iter().collect();
        sorted.sort_by(|a, b| in_order(&a.name, &b.name));
        let mut out = Vec::new();
        lines(&modules(&sorted, 0, 1, &|_, _| ()), "", &mut out);
        out
    }

    #[test]
    fn equal_siblings_are_one_line_with_the_amounts_of_all() {
        let names = ["l.0.a.w", "l.1.a.w", "l.2.a.w", "l.0.b.w", "l.1.b.w", "l.2.b.w", "n.w"];
        assert_eq!(shown(&names), ["l.0 to l.2 (3): 6", " l.0.a: 3", " l.0.b: 3", "n: 1"]);
    }

    #[test]
    fn siblings_with_other_names_or_shapes_end_a_run() {
        assert_eq!(
            shown(&["l.0.w", "l.1.w", "l.2.w!", "l.3.w", "l.4.v"]),
            ["l: 5", " l.0 to l.1 (2): 2", " l.2: 1", " l.3: 1", " l.4: 1"]
        );
        assert_eq!(shown(&["l.0.w", "l.1.w", "l.1.b"]), ["l: 3", " l.0: 1", " l.1: 2"]);
    }

    #[test]
    fn gaps_end_a_run_and_numbers_are_in_order() {
        assert_eq!(
            shown(&["l.10.w", "l.9.w", "l.2.w", "l.1.w", "l.4.w"]),
            ["l: 5", " l.1 to l.2 (2): 2", " l.4: 1", " l.9 to l.10 (2): 2"]
        );
    }

    #[test]
    fn words_and_odd_numbers_are_not_repeats() {
        assert_eq!(
            shown(&["l.a.w", "l.b.w", "l.00.w", "l.01.w", "l.block1.w", "l.block2.w"]),
            ["l: 6", " l.00: 1", " l.01: 1", " l.a: 1", " l.b: 1", " l.block1: 1", " l.block2: 1"]
        );
        let beyond = ["l.18446744073709551615.w", "l.18446744073709551616.w"];
        assert_eq!(shown(&beyond)[1..], [" l.18446744073709551615: 1", " l.18446744073709551616: 1"]);
    }

    #[test]
    fn repeats_in_repeats_are_folded_and_counted_together() {
        let of = |l: usize| (0..8).map(move |e| format!("m.layers.{l}.experts.{e}.w"));
        let names: Vec<String> = (0..32).flat_map(of).chain((0..32).map(|l| format!("m.layers.{l}.norm.w"))).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let expected = [
            "m.layers.0 to m.layers.31 (32): 288",
            " m.layers.0.experts.0 to m.layers.0.experts.7 (8): 256",
            " m.layers.0.norm: 32",
        ];
        assert_eq!(shown(&names), expected);
    }

    #[test]
    fn tensors_beside_modules_have_lines_and_others_have_none() {
        assert_eq!(shown(&["m.a.w", "m.a.b", "m.scale"]), ["m: 3", " m.a: 2", " m.scale: 1"]);
        assert_eq!(shown(&["x", "y"]), ["x: 1", "y: 1"]);
        // A name of a tensor and of a module.
        assert_eq!(shown(&["m.a", "m.a.w", "m.b.w"]), ["m: 3", " m.a: 2", " m.b: 1"]);
        assert_eq!(shown(&["m", "m.a.w"]), ["m: 2", " m.a: 1"]);
    }

    #[test]
    fn odd_names_are_divided_like_others_and_not_without_end() {
        assert_eq!(shown(&["", ".", "..", "a."]), [": 3", " .: 2", "a: 1"]);
        let deep = "a.".repeat(9000);
        let names: Vec<String> = (0..9000).step_by(2).map(|n| format!("{}w", &deep[..n])).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let deepest = shown(&names).iter().map(|line| line.bytes().take_while(|c| *c == b' ').count()).max();
        assert!(deepest <= Some(super::PARTS), "{deepest:?}");
    }
}
