//! The tensors of the result: their origin, transform and shape.

use std::collections::{BTreeMap, HashMap};

use regex::Regex;
use serde_json::Value;

use super::context::{Context, Donor};
use super::documents::MergedDocument;
use super::draft::MergeDraft;
use super::error::MergeError;
use super::explain;
use super::run::count;
use crate::checkpoint::{Shard, Tensor};
use crate::knowledge::recipe::TensorSpec;
use crate::knowledge::{Evidence, Library, Loader};
use crate::report::model::{ChangedTensor, Dropped, Seam, ShapedName};
use crate::surgery::plan::{PlannedTensor, TensorRef, TensorSource, TensorTransform, into_shards};
use crate::surgery::transform::can_compute;

/// A tensor spec with its parts evaluated once.
struct TensorRule<'a> {
    spec: &'a TensorSpec,
    names: Regex,
    rename: Option<String>,
    fit: TensorTransform,
}

/// A donor tensor that the recipe selects, with its name in the result.
struct TakenTensor<'a> {
    name: String,
    donor: &'a Donor,
    shard: &'a Shard,
    tensor: &'a Tensor,
    rule: &'a TensorRule<'a>,
}

/// Plans the shards of the result; shape mismatches become seams of the draft.
pub(super) fn plan(
    context: &Context<'_>,
    documents: &[MergedDocument],
    library: &Library,
    limit: u64,
    draft: &mut MergeDraft,
) -> Result<(), MergeError> {
    let rules = rules(context)?;
    let (taken, dropped) = take(context.donors, &rules);
    if taken.is_empty() {
        return Err(nothing_taken(context, &rules));
    }
    draft.dropped = dropped;
    let evidence: Evidence = taken.iter().map(|t| (t.name.clone(), Some(t.tensor.shape.clone()))).collect();
    let names = taken.iter().map(|t| t.name.as_str());
    let config = documents.iter().find(|b| b.document.name == "config.json").and_then(|b| b.document.value.as_ref());
    let expected = expected_shapes(library, config, names, &evidence);
    let mut tensors = Vec::new();
    let mut seen: HashMap<String, String> = HashMap::new();
    for taken in taken {
        if let Some(first) = seen.insert(taken.name.clone(), taken.tensor.name.clone()) {
            return Err(MergeError::Recipe(format!(
                "{}: {first} and {} would both become {}",
                context.recipe.recipe, taken.tensor.name, taken.name
            )));
        }
        let (position, shape) = match expected.get(&taken.name) {
            Some((position, shape)) => (*position, shape.clone()),
            None => (usize::MAX, taken.tensor.shape.clone()),
        };
        match source(&taken, &shape) {
            Ok(source) => tensors.push((position, planned(taken, shape, source, draft))),
            Err(why) => draft.seams.push(misfit(context, &taken, shape, &why)),
        }
    }
    // In the order of the class, so that shards are split where save_pretrained would split them.
    tensors.sort_by(|a, b| a.0.cmp(&b.0).then_with(|| a.1.name.cmp(&b.1.name)));
    draft.plan.shards = into_shards(tensors.into_iter().map(|t| t.1).collect(), limit);
    Ok(())
}

/// The reason why the result would have no tensor.
fn nothing_taken(context: &Context<'_>, rules: &[TensorRule<'_>]) -> MergeError {
    let kept = || rules.iter().filter(|rule| rule.spec.drop.is_none());
    let donor = |donor: &&Donor| kept().any(|rule| rule.spec.from == donor.role);
    let reason = |donor: &Donor| {
        let role = &donor.role;
        explain::without_tensors(donor).map_or_else(
            || {
                let patterns: Vec<&str> =
                    kept().filter(|rule| rule.spec.from == *role).map(|rule| rule.spec.names.as_str()).collect();
                let count = count(donor.checkpoint.tensors().count(), "tensor", "tensors");
                format!("none of the {role} donor's {count} is taken by {}", patterns.join(", "))
            },
            |reason| format!("the {role} donor has no tensors: {reason}"),
        )
    };
    let reasons: Vec<String> = context.donors.iter().filter(donor).map(reason).collect();
    let reasons = if reasons.is_empty() { "no entry of `tensors` applies".to_owned() } else { reasons.join("; ") };
    MergeError::Donor(format!("recipe {}: the result would have no tensors: {reasons}", context.recipe.recipe))
}

/// The tensors that the recipe selects, and the others.
fn take<'a>(donors: &'a [Donor], rules: &'a [TensorRule<'a>]) -> (Vec<TakenTensor<'a>>, Vec<Dropped>) {
    let mut taken = Vec::new();
    let mut dropped: BTreeMap<(String, String, String), usize> = BTreeMap::new();
    for donor in donors {
        for (shard, tensor) in donor.checkpoint.tensors() {
            let rule = rules.iter().find(|r| r.spec.from == donor.role && r.names.is_match(&tensor.name));
            match rule {
                Some(rule) if rule.spec.drop.is_none() => {
                    let name = match &rule.rename {
                        Some(to) => rule.names.replace(&tensor.name, to.as_str()).into_owned(),
                        None => tensor.name.clone(),
                    };
                    taken.push(TakenTensor { name, donor, shard, tensor, rule });
                }
                other => {
                    let (pattern, why) = other.map_or(("", "no entry of the recipe matches them"), |r| {
                        (r.spec.names.as_str(), r.spec.drop.as_deref().unwrap_or_default())
                    });
                    let key = (donor.role.clone(), pattern.to_owned(), why.to_owned());
                    let count = dropped.entry(key).or_default();
                    *count = count.saturating_add(1);
                }
            }
        }
    }
    let dropped = dropped.into_iter();
    (taken, dropped.map(|((donor, pattern, why), count)| Dropped { donor, pattern, count, why }).collect())
}

/// The planned tensor; if it is not a byte copy, the draft lists it as changed.
fn planned(taken: TakenTensor<'_>, shape: Vec<u64>, source: TensorSource, draft: &mut MergeDraft) -> PlannedTensor {
    let TakenTensor { name, tensor, .. } = taken;
    if !matches!(source, TensorSource::Copy(_)) {
        draft.changed.push(ChangedTensor {
            name: name.clone(),
            transform: source.transform(),
            from: Some(tensor.shape.clone()),
            to: shape.clone(),
        });
    }
    PlannedTensor { name, dtype: tensor.dtype, shape, source }
}

fn rules<'a>(context: &Context<'a>) -> Result<Vec<TensorRule<'a>>, MergeError> {
    let mut out = Vec::new();
    for spec in &context.recipe.tensors {
        if !context.holds(spec.when.as_ref(), &spec.names)? {
            continue;
        }
        let names = Regex::new(&spec.names)
            .map_err(|e| MergeError::Recipe(format!("{}: {}: {e}", context.recipe.recipe, spec.names)))?;
        let rename = spec
            .rename
            .as_ref()
            .map(|t| t.try_render(&context.scope))
            .transpose()
            .map_err(context.at(spec.names.as_str()))?;
        let fit = match &spec.fit {
            None => TensorTransform::Copy,
            Some(e) => {
                let value = e.eval(&context.scope).map_err(context.at(spec.names.as_str()))?;
                serde_json::from_value(value.clone()).map_err(|_| {
                    MergeError::Recipe(format!(
                        "{}: fit of {} is {value}, not copy, pad, grow-rows or reinit",
                        context.recipe.recipe, spec.names
                    ))
                })?
            }
        };
        out.push(TensorRule { spec, names, rename, fit });
    }
    Ok(out)
}

/// Position and shape of each tensor that the class has with the planned config.
fn expected_shapes<'n>(
    library: &Library,
    config: Option<&Value>,
    names: impl Iterator<Item = &'n str>,
    evidence: &Evidence,
) -> HashMap<String, (usize, Vec<u64>)> {
    let Some(config) = config else { return HashMap::new() };
    let found =
        library.find(config, names, Loader::of_config(config)).and_then(|a| a.expect_given(config, evidence).ok());
    found.map_or_else(HashMap::new, |e| {
        e.tensors.iter().enumerate().map(|(i, (name, t))| (name.clone(), (i, t.shape.clone()))).collect()
    })
}

/// The source of a tensor of `shape`, or the reason why the donor tensor cannot be used.
fn source(taken: &TakenTensor<'_>, shape: &[u64]) -> Result<TensorSource, String> {
    let TakenTensor { donor, shard, tensor, rule, .. } = taken;
    let from = TensorRef {
        donor: donor.role.clone(),
        path: donor.checkpoint.root.join(&shard.name),
        name: tensor.name.clone(),
        shape: tensor.shape.clone(),
        offset: shard.data_start.saturating_add(tensor.begin),
        len: tensor.len(),
    };
    if rule.fit != TensorTransform::Reinit && tensor.shape == shape {
        return Ok(TensorSource::Copy(from));
    }
    if rule.fit != TensorTransform::Copy && !can_compute(tensor.dtype) {
        return Err(format!("values of type {} can only be copied", tensor.dtype));
    }
    let same_rank = tensor.shape.len() == shape.len();
    let nests = same_rank && tensor.shape.iter().zip(shape).all(|(have, want)| have <= want);
    match rule.fit {
        TensorTransform::Copy => Err(String::new()),
        TensorTransform::Reinit => Ok(TensorSource::Reinit { instead_of: from }),
        TensorTransform::Pad if nests => Ok(TensorSource::Pad(from)),
        TensorTransform::Pad => Err("padding cannot shrink a tensor".to_owned()),
        TensorTransform::GrowRows if nests && tensor.shape.iter().skip(1).eq(shape.iter().skip(1)) => {
            Ok(TensorSource::GrowRows(from))
        }
        TensorTransform::GrowRows => Err("only rows can be added".to_owned()),
    }
}

/// The seam for a tensor with a shape mismatch.
fn misfit(context: &Context<'_>, taken: &TakenTensor<'_>, needed: Vec<u64>, why: &str) -> Seam {
    let TakenTensor { name, donor, tensor, rule, .. } = taken;
    Seam {
        message: format!(
            "{} of the {} donor is {:?}, {} must be {needed:?}{}{why}",
            tensor.name,
            donor.role,
            tensor.shape,
            if *name == tensor.name { "in the merged model it" } else { name },
            if why.is_empty() { "" } else { "; " },
        ),
        tensor: Some(ShapedName { donor: donor.role.clone(), name: tensor.name.clone(), shape: tensor.shape.clone() }),
        meets: rule.spec.meets.as_ref().and_then(|m| context.shaped(m)),
        needed: Some(needed),
        options: rule.spec.options.iter().map(|o| format!("--set {o}")).collect(),
    }
}
