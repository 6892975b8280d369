//! Converters of transformers 5 on shapes: what its operations make of the tensors they are given.

use indexmap::IndexMap;
use serde_json::Value;

use crate::knowledge::{Conversion, Expected};

/// What is known of a tensor's shape.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Shape {
    /// All of it.
    Known(Vec<u64>),
    /// A stack of so many tensors of unknown shape: of an index whose shards are not there.
    Stack(u64),
    /// Nothing.
    Unknown,
}

/// Tensors by the source or target pattern they stand for.
pub(super) type Tensors = IndexMap<String, Vec<Shape>>;

/// Why an operation fails.
type Failure = String;

/// What a converter makes of what was collected for `target`: full names of model tensors, with their shapes.
pub(super) fn convert(
    row: &Conversion,
    target: &str,
    mut tensors: Tensors,
    expected: &Expected,
) -> Result<Vec<(String, Shape)>, Failure> {
    for op in &row.ops {
        tensors = Operation { text: op, row, target, expected }.apply(tensors)?;
    }
    let full = if target.contains("*.") { target.replace("*.", "0.") } else { target.to_owned() };
    let around = tensors.keys().find_map(|name| full.split_once(name.as_str()));
    let (before, after) = around.unwrap_or(("", ""));
    Ok(tensors
        .iter()
        .filter_map(|(name, shapes)| Some((format!("{before}{name}{after}"), shapes.first()?.clone())))
        .collect())
}

/// One operation, `MergeModulelist{"dim": 0}`, at work for one target.
struct Operation<'a> {
    text: &'a str,
    row: &'a Conversion,
    target: &'a str,
    expected: &'a Expected,
}

impl Operation<'_> {
    fn apply(&self, tensors: Tensors) -> Result<Tensors, Failure> {
        let (name, arguments) = self.text.split_at(self.text.find('{').unwrap_or(self.text.len()));
        let arguments: Value = serde_json::from_str(arguments).unwrap_or_default();
        let dim = |key: &str, default: usize| {
            arguments.get(key).and_then(Value::as_u64).and_then(|d| usize::try_from(d).ok()).unwrap_or(default)
        };
        match name {
            "MergeModulelist" => self.merge(tensors, dim("dim", 0)),
            "Concatenate" => self.concatenate(tensors, dim("dim", 0)),
            "Chunk" => self.chunk(&tensors, dim("dim", 0)),
            "Split" => self.split(&tensors, dim("dim", 0)),
            "Transpose" => {
                let check = arguments.get("check_dims").and_then(Value::as_bool).unwrap_or(false);
                self.transpose(&tensors, (dim("dim0", 0), dim("dim1", 1)), check)
            }
            "Interleave" => self.interleave(&tensors, dim("dim", 0)),
            "PermuteForRope" => {
                self.permute(tensors, arguments.get("subconfig_key").and_then(Value::as_str).unwrap_or_default())
            }
            "ErnieFuseAndSplitTextVisionExperts" => self.ernie(&tensors, dim("stack_dim", 0), dim("concat_dim", 1)),
            // Not in the tables that were read: that it works is the likelier case.
            _ => Ok(self.row.to.iter().map(|to| (to.clone(), vec![Shape::Unknown])).collect()),
        }
    }

    /// Stacks the tensors of each source.
    fn merge(&self, tensors: Tensors, dim: usize) -> Result<Tensors, Failure> {
        let single = tensors.len() == 1;
        let merged = tensors.into_iter().map(|(source, shapes)| {
            let name = match (single, self.row.to.as_slice()) {
                (false, _) => source,
                (true, [only]) => only.clone(),
                (true, _) => return Err(undefined()),
            };
            Ok((name, vec![stack(&shapes, dim)?]))
        });
        merged.collect()
    }

    fn concatenate(&self, mut tensors: Tensors, dim: usize) -> Result<Tensors, Failure> {
        let [target] = self.row.to.as_slice() else { return Err(undefined()) };
        // In the order of the patterns, not of the file.
        let all: Vec<Shape> = self.row.from.iter().filter_map(|from| tensors.shift_remove(from)).flatten().collect();
        Ok(one(target, cat(&all, dim)?))
    }

    fn chunk(&self, tensors: &Tensors, dim: usize) -> Result<Tensors, Failure> {
        let count = u64::try_from(self.row.to.len()).unwrap_or(u64::MAX);
        let pieces = match only(tensors)? {
            Shape::Known(dims) => {
                let size = *dims.get(dim).ok_or_else(out_of_range)?;
                // As torch: of equal size but the last, and fewer when they do not come out.
                let piece = size.div_ceil(count.max(1)).max(1);
                let starts = (0..count).map(|i| piece.saturating_mul(i)).take_while(|start| *start < size.max(1));
                starts.map(|start| resized(dims, dim, piece.min(size.saturating_sub(start)))).collect()
            }
            _ => vec![Shape::Unknown; self.row.to.len()],
        };
        Ok(self.row.to.iter().cloned().zip(pieces.into_iter().map(|p| vec![p])).collect())
    }

    /// Into pieces as large as the model's tensors.
    fn split(&self, tensors: &Tensors, dim: usize) -> Result<Tensors, Failure> {
        let first = self.row.to.first().ok_or_else(undefined)?;
        let sizes = self.row.to.iter().map(|to| {
            let tensor = self.expected.tensors.get(&self.target.replace(first.as_str(), to));
            let size = tensor.and_then(|t| t.shape.get(dim)).copied();
            size.ok_or_else(|| format!("the class has no {to} to split into"))
        });
        let sizes: Vec<u64> = sizes.collect::<Result<_, _>>()?;
        let piece = |size: u64| match only(tensors)? {
            Shape::Known(dims) => {
                let whole = *dims.get(dim).ok_or_else(out_of_range)?;
                if sizes.iter().fold(0_u64, |n, s| n.saturating_add(*s)) != whole {
                    return Err(format!("{whole} rows do not split into {sizes:?}"));
                }
                Ok(resized(dims, dim, size))
            }
            _ => Ok(Shape::Unknown),
        };
        self.row.to.iter().zip(&sizes).map(|(to, size)| Ok((to.clone(), vec![piece(*size)?]))).collect()
    }

    fn transpose(&self, tensors: &Tensors, (a, b): (usize, usize), check: bool) -> Result<Tensors, Failure> {
        let shape = only(tensors)?;
        let name = match (self.row.to.as_slice(), self.row.from.as_slice()) {
            ([only], _) => only,
            (_, [first]) => first,
            _ => return Err(undefined()),
        };
        let Shape::Known(dims) = shape else { return Ok(one(name, shape.clone())) };
        if check {
            let wanted = self.expected.tensors.get(self.target).ok_or_else(undefined)?;
            if wanted.shape == *dims {
                return Ok(one(name, shape.clone()));
            }
        }
        if a.max(b) >= dims.len() {
            return Err(out_of_range());
        }
        let mut turned = dims.clone();
        turned.swap(a, b);
        Ok(one(name, Shape::Known(turned)))
    }

    fn interleave(&self, tensors: &Tensors, dim: usize) -> Result<Tensors, Failure> {
        let shape = first(tensors)?;
        if let Shape::Known(dims) = shape
            && dims.get(dim).ok_or_else(out_of_range)? % 2 != 0
        {
            return Err("an odd number of rows cannot be deinterleaved".to_owned());
        }
        Ok(one(self.row.to.first().ok_or_else(undefined)?, shape.clone()))
    }

    /// Keeps every shape; the rows have to be two halves of a whole number of heads.
    fn permute(&self, tensors: Tensors, part: &str) -> Result<Tensors, Failure> {
        let config = self.expected.config.get(part).unwrap_or(&self.expected.config);
        let heads = config.get("num_attention_heads").and_then(Value::as_u64).unwrap_or(1);
        let permuted = tensors.into_iter().map(|(source, shapes)| {
            let name = match (self.row.to.as_slice(), self.row.from.as_slice()) {
                ([to], [_]) => to.clone(),
                ([_], _) | (_, [_]) => source,
                _ => return Err(undefined()),
            };
            let [shape] = shapes.as_slice() else { return Err("more than one tensor to permute".to_owned()) };
            match shape {
                Shape::Known(dims) if dims.len() == 1 || dims.len() == 2 => {
                    let rows = dims.first().copied().unwrap_or_default();
                    let half = rows.checked_div(heads).unwrap_or_default() / 2;
                    if half.saturating_mul(2).saturating_mul(heads) != rows {
                        return Err(format!("{rows} rows are not two halves of {heads} heads"));
                    }
                }
                _ => {}
            }
            Ok((name, shapes))
        });
        permuted.collect()
    }

    /// Splits each list of experts over the targets, stacks the parts, and joins those of one target.
    fn ernie(&self, tensors: &Tensors, stack_dim: usize, concat_dim: usize) -> Result<Tensors, Failure> {
        let mut fused: Vec<Vec<Shape>> = vec![Vec::new(); self.row.to.len()];
        for from in &self.row.from {
            let shapes = tensors.get(from).ok_or_else(|| format!("nothing is stored for {from}"))?;
            let size = shapes.len().div_ceil(fused.len().max(1)).max(1);
            let mut parts = shapes.chunks(size);
            for target in &mut fused {
                target.push(stack(parts.next().unwrap_or_default(), stack_dim)?);
            }
        }
        self.row.to.iter().zip(fused).map(|(to, parts)| Ok((to.clone(), vec![cat(&parts, concat_dim)?]))).collect()
    }
}

fn one(name: &str, shape: Shape) -> Tensors {
    Tensors::from([(name.to_owned(), vec![shape])])
}

fn undefined() -> Failure {
    "Undefined Operation encountered!".to_owned()
}

fn out_of_range() -> Failure {
    "Dimension out of range".to_owned()
}

/// The one tensor of an operation that takes one.
fn only(tensors: &Tensors) -> Result<&Shape, Failure> {
    if tensors.len() == 1 { first(tensors) } else { Err(undefined()) }
}

fn first(tensors: &Tensors) -> Result<&Shape, Failure> {
    tensors.values().next().and_then(|shapes| shapes.first()).ok_or_else(undefined)
}

fn resized(dims: &[u64], dim: usize, size: u64) -> Shape {
    let resized = dims.iter().enumerate().map(|(i, d)| if i == dim { size } else { *d });
    Shape::Known(resized.collect())
}

/// `torch.stack`: all of one shape.
fn stack(shapes: &[Shape], dim: usize) -> Result<Shape, Failure> {
    let count = u64::try_from(shapes.len()).unwrap_or(u64::MAX);
    let mut known = shapes.iter().filter_map(|s| if let Shape::Known(dims) = s { Some(dims) } else { None });
    let Some(dims) = known.next() else {
        return if count == 0 {
            Err("stack expects a non-empty list of tensors".to_owned())
        } else {
            Ok(Shape::Stack(count))
        };
    };
    if let Some(other) = known.find(|other| *other != dims) {
        return Err(format!("stack expects each tensor to be equal size, but got {dims:?} and {other:?}"));
    }
    if dim > dims.len() {
        return Err(out_of_range());
    }
    let mut dims = dims.clone();
    dims.insert(dim, count);
    Ok(Shape::Known(dims))
}

/// `torch.cat`: all of one shape but for `dim`. An empty vector goes with anything.
fn cat(shapes: &[Shape], dim: usize) -> Result<Shape, Failure> {
    if shapes.is_empty() {
        return Err("expected a non-empty list of tensors".to_owned());
    }
    let mut joined: Option<Vec<u64>> = None;
    let mut stacked: Option<u64> = None;
    let mut all_known = true;
    for shape in shapes {
        match (shape, &mut joined) {
            (Shape::Known(dims), _) if *dims == [0] => {}
            (Shape::Known(dims), None) if dim < dims.len() => joined = Some(dims.clone()),
            (Shape::Known(_), None) => return Err(out_of_range()),
            (Shape::Known(dims), Some(so_far)) => {
                let size = *dims.get(dim).ok_or_else(out_of_range)?;
                let at = so_far.get_mut(dim).ok_or_else(out_of_range)?;
                let total = at.saturating_add(size);
                *at = size;
                if so_far != dims {
                    return Err(format!(
                        "sizes of tensors must match except in dimension {dim}: {so_far:?} and {dims:?}"
                    ));
                }
                if let Some(at) = so_far.get_mut(dim) {
                    *at = total;
                }
            }
            (Shape::Stack(count), _) => {
                all_known = false;
                if dim > 0 && stacked.is_some_and(|n| n != *count) {
                    return Err(format!("{} and {count} tensors are to be joined", stacked.unwrap_or_default()));
                }
                stacked = Some(*count);
            }
            (Shape::Unknown, _) => all_known = false,
        }
    }
    Ok(match (joined, stacked) {
        (Some(dims), _) if all_known => Shape::Known(dims),
        (None, Some(count)) if dim > 0 => Shape::Stack(count),
        _ => Shape::Unknown,
    })
}
