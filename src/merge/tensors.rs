//! The tensors of the result: their origin, transform and shape.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet, HashMap};

use serde_json::Value;

use super::adapter::MergedAdapter;
use super::context::Context;
use super::documents::MergedDocument;
use super::draft::MergeDraft;
use super::error::MergeError;
use super::explain;
use super::fit::Fit;
use super::named::{AnnouncedCast, Bounds, Changeable, pattern};
use super::parts::{Donor, DonorParts, PartOf};
use super::run::count;
use super::taken::{StartedModules, TakenTensor, TensorRule, WordMapping};
use crate::checkpoint::{Dtype, Tensor};
use crate::knowledge::quantization;
use crate::knowledge::recipe::{SeamTensor, TensorSpec};
use crate::knowledge::{Evidence, Expression, Initial, Knowledge, Library, Loader};
use crate::report::model::{Cast, ChangedTensor, Dropped, Seam, ShapedName};
use crate::surgery::expr::{Mapped, NewValues, TensorExpr, TensorTransform};
use crate::surgery::plan::into_shards;
use crate::surgery::planned_tensor::PlannedTensor;
use crate::surgery::tensor_ref::TensorRef;
use crate::surgery::values::can_compute;

/// Plans the shards of the result; shape mismatches become seams of the draft.
pub(super) fn plan(
    context: &Context<'_>,
    documents: &[MergedDocument],
    knowledge: &Knowledge,
    limit: u64,
    draft: &mut MergeDraft,
) -> Result<(), MergeError> {
    let rules = rules(context)?;
    let (taken, dropped) = take(context.donors, &rules)?;
    if taken.is_empty() {
        return Err(nothing_taken(context, &rules));
    }
    rules.iter().try_for_each(|rule| rule.takes_all(&taken))?;
    draft.dropped = dropped;
    draft.seams.extend(context.donors.iter().filter_map(|donor| quantised(donor, &taken)));
    let evidence: Evidence = taken.iter().map(|t| (t.name.clone(), Some(t.shape()))).collect();
    let names = taken.iter().map(|t| t.name.as_str());
    let config = documents.iter().find(|b| b.document.name == files::CONFIG).and_then(|b| b.document.value.as_ref());
    // The class of a newer version has other names than the checkpoint, which it renames when it loads.
    let place = rules.iter().find_map(|rule| rule.into.as_ref());
    let spelled = |name: &str| place?.0.spelled(name);
    let expected = expected_shapes(&knowledge.library, config, names, &evidence, &spelled);
    distinct(context, &taken)?;
    let places: Vec<(usize, Vec<u64>)> =
        taken.iter().map(|t| expected.get(&t.name).cloned().unwrap_or_else(|| (usize::MAX, t.shape()))).collect();
    let started = StartedModules::find(taken.iter().zip(&places).map(|(t, (_, shape))| (t, shape.as_slice())));
    draft.notes.extend(kept_modules(&rules, &taken, &started));
    let mut tensors = Vec::new();
    for (taken, (position, shape)) in taken.into_iter().zip(places) {
        let values = started.has(&taken).then(|| {
            config
                .and_then(|config| knowledge.initial.of(&knowledge.parts, config, &taken.name, &shape))
                .map(in_numbers)
                .ok_or_else(|| UNKNOWN_VALUES.to_owned())
        });
        match source(&taken, &shape, values).and_then(|source| PlannedTensor::new(taken.name.clone(), source)) {
            Ok(planned) => {
                record(&taken, &planned, draft);
                tensors.push((position, planned));
            }
            Err(why) => draft.seams.push(misfit(context, &taken, shape, &why)),
        }
    }
    // Tensors with another shape first: there may be hundreds of casts.
    draft.changed.sort_by_key(|changed| changed.transform == TensorTransform::Convert);
    // In the order of the class, so that shards are split where save_pretrained would split them.
    tensors.sort_by(|a, b| a.0.cmp(&b.0).then_with(|| a.1.name.cmp(&b.1.name)));
    draft.plan.shards = into_shards(tensors.into_iter().map(|t| t.1).collect(), limit);
    draft.notes.extend(blind(draft));
    draft.changeable = changeable(&rules);
    let bounds = Bounds::new(&draft.changeable).map_err(MergeError::Recipe)?;
    bounds.hold(&context.recipe.recipe, &draft.plan)
}

/// What the entries of the recipe may change with these donors and options.
fn changeable(rules: &[TensorRule<'_>]) -> Changeable {
    let kept = || rules.iter().filter(|rule| rule.spec.drop.is_none());
    let casts: BTreeSet<AnnouncedCast> = kept().flat_map(TensorRule::casts).collect();
    Changeable {
        named: kept().filter_map(TensorRule::changeable).collect(),
        casts: casts.into_iter().collect(),
        merged: kept().filter_map(TensorRule::merged).collect(),
    }
}

/// Fails when two tensors would have one name.
fn distinct(context: &Context<'_>, taken: &[TakenTensor<'_>]) -> Result<(), MergeError> {
    let mut seen: HashMap<&str, &str> = HashMap::new();
    for taken in taken {
        if let Some(first) = seen.insert(&taken.name, &taken.tensor.name) {
            return Err(MergeError::Recipe(format!(
                "{}: {first} and {} would both become {}",
                context.recipe.recipe, taken.tensor.name, taken.name
            )));
        }
    }
    Ok(())
}

/// A note for each entry that says `reinit`, and of whose tensors none starts again.
fn kept_modules(rules: &[TensorRule<'_>], taken: &[TakenTensor<'_>], started: &StartedModules) -> Vec<String> {
    let note = |rule: &TensorRule<'_>| {
        let mut own = taken.iter().filter(|taken| std::ptr::eq(taken.rule, rule)).peekable();
        own.peek()?;
        (!own.any(|taken| started.has(taken))).then(|| {
            format!(
                "Nothing of {} of the {} donor was reinitialised: every module has the shape that the result needs. reinit-always reinitialises it all the same.",
                rule.pattern(),
                rule.spec.from
            )
        })
    };
    rules.iter().filter(|rule| rule.fit == Fit::Reinit && rule.spec.drop.is_none()).filter_map(note).collect()
}

/// A note for matrices that start with zeros: what they multiply has no effect at first.
fn blind(draft: &MergeDraft) -> Option<String> {
    let is_blind = |t: &&PlannedTensor| t.source.values() == Some(NewValues::Zeros) && t.shape.len() > 1;
    let names: Vec<&str> = draft.plan.tensors().map(|(_, t)| t).filter(is_blind).map(|t| t.name.as_str()).collect();
    let (first, others) = names.split_first()?;
    let more = if others.is_empty() { String::new() } else { format!(", and {} more", others.len()) };
    Some(format!(
        "{first}{more}: its class starts it with zeros, so that what it multiplies has no effect until it is trained."
    ))
}

/// The values of a new tensor, as a plan has them.
const fn in_numbers(initial: Initial) -> NewValues {
    match initial {
        Initial::Zeros => NewValues::Zeros,
        Initial::Ones => NewValues::Ones,
        Initial::Normal(deviation) => NewValues::Normal(deviation),
        Initial::Uniform(limit) => NewValues::Uniform(limit),
    }
}

/// The reason why the result would have no tensor.
fn nothing_taken(context: &Context<'_>, rules: &[TensorRule<'_>]) -> MergeError {
    let kept = || rules.iter().filter(|rule| rule.spec.drop.is_none());
    let donor = |donor: &&Donor| kept().any(|rule| rule.spec.from == donor.role);
    let reason = |donor: &Donor| {
        let role = &donor.role;
        explain::empty(donor).unwrap_or_else(|| {
            let patterns: Vec<&str> =
                kept().filter(|rule| rule.spec.from == *role).map(|rule| rule.spec.names.as_str()).collect();
            let count = count(donor.checkpoint.tensors().count(), "tensor", "tensors");
            format!("none of the {role} donor's {count} is taken by {}", patterns.join(", "))
        })
    };
    let reasons: Vec<String> = context.donors.iter().filter(donor).map(reason).collect();
    let reasons = if reasons.is_empty() { "no entry of `tensors` applies".to_owned() } else { reasons.join("; ") };
    MergeError::Donor(format!("recipe {}: the result would have no tensors: {reasons}", context.recipe.recipe))
}

/// The tensors that the recipe selects, and the others.
fn take<'a>(
    donors: &'a [Donor],
    rules: &'a [TensorRule<'a>],
) -> Result<(Vec<TakenTensor<'a>>, Vec<Dropped>), MergeError> {
    let mut taken = Vec::new();
    let mut dropped: BTreeMap<(String, String, String), usize> = BTreeMap::new();
    for donor in donors {
        for (shard, tensor) in donor.checkpoint.tensors() {
            let mut last = None;
            for rule in rules.iter().filter(|rule| rule.takes(donor, tensor)) {
                last = Some(rule);
                if rule.spec.drop.is_none() {
                    let name = rule.name(tensor).ok_or_else(|| has_no_place(rule, donor, tensor))?;
                    taken.push(TakenTensor { name, donor, shard, tensor, rule });
                }
                if !rule.spec.also {
                    break;
                }
            }
            if last.is_none_or(|rule| rule.spec.drop.is_some()) {
                let (pattern, why) = last.map_or(("", "no entry of the recipe matches them"), |rule| {
                    (rule.pattern(), rule.spec.drop.as_deref().unwrap_or_default())
                });
                let key = (donor.role.clone(), pattern.to_owned(), why.to_owned());
                let count = dropped.entry(key).or_default();
                *count = count.saturating_add(1);
            }
        }
    }
    let dropped = dropped.into_iter();
    Ok((taken, dropped.map(|((donor, pattern, why), count)| Dropped { donor, pattern, count, why }).collect()))
}

fn has_no_place(rule: &TensorRule<'_>, donor: &Donor, tensor: &Tensor) -> MergeError {
    MergeError::Donor(format!(
        "{} of the {} donor has no place in the model of the {} donor",
        tensor.name,
        donor.role,
        rule.spec.into.as_deref().unwrap_or_default()
    ))
}

/// Lists a tensor that is not a byte copy of a whole donor tensor as changed, and one that must be trained.
fn record(taken: &TakenTensor<'_>, planned: &PlannedTensor, draft: &mut MergeDraft) {
    let (tensor, from) = (taken.tensor, planned.source.main());
    let transform = planned.transform();
    let has_new_values = match transform {
        TensorTransform::Copy | TensorTransform::Convert | TensorTransform::AddProduct => false,
        TensorTransform::GrowRows
        | TensorTransform::SampleRows
        | TensorTransform::NewRows
        | TensorTransform::Pad
        | TensorTransform::Map
        | TensorTransform::Reinit => true,
    };
    if has_new_values || taken.rule.spec.train {
        draft.train.insert(planned.name.clone());
    }
    if planned.copied().is_none_or(|from| from.slice.is_some()) {
        draft.changed.push(ChangedTensor {
            name: planned.name.clone(),
            transform,
            from: Some(tensor.shape.clone()),
            to: planned.shape.clone(),
            scale: planned.source.scale(),
            values: planned.source.values().map(NewValues::words),
            cast: (from.dtype != planned.dtype && transform != TensorTransform::Reinit)
                .then(|| Cast { from: from.dtype.name(), to: planned.dtype.name() }),
            losses: None,
        });
    }
}

/// The seam for a donor whose quantised weights would be cast in part: its scales belong to their type.
fn quantised(donor: &Donor, taken: &[TakenTensor<'_>]) -> Option<Seam> {
    let config = donor.checkpoint.document(files::CONFIG)?.value.as_ref()?;
    quantization::block(config)?;
    let cast = taken.iter().find(|t| t.donor.role == donor.role && t.dtype() != t.tensor.dtype)?;
    Some(Seam {
        message: format!(
            "the {} donor is quantised, and a cast of {} from {} to {} would not fit its quantisation; dequantise the donor, or keep its types",
            donor.role,
            cast.tensor.name,
            cast.tensor.dtype,
            cast.dtype(),
        ),
        tensor: None,
        meets: None,
        needed: None,
        options: Vec::new(),
    })
}

fn rules<'a>(context: &Context<'a>) -> Result<Vec<TensorRule<'a>>, MergeError> {
    let mut out = Vec::new();
    for spec in &context.recipe.tensors {
        if !context.holds(spec.when.as_ref(), &spec.names)? {
            continue;
        }
        let names = pattern(&spec.names)
            .map_err(|e| MergeError::Recipe(format!("{}: {}: {e}", context.recipe.recipe, spec.names)))?;
        let rename = spec
            .rename
            .as_ref()
            .map(|t| t.try_render(&context.scope))
            .transpose()
            .map_err(context.at(spec.names.as_str()))?;
        let value = |key: &str, expression: &Option<Expression>| match expression {
            None => Ok(Value::Null),
            Some(e) => e.eval(&context.scope).map_err(context.at(format!("{key} of {}", spec.names))),
        };
        let name =
            spec.part.as_ref().map(|part| part.try_render(&context.scope)).transpose().map_err(context.at("part"))?;
        let part_of = |role: &str| name.as_ref().map(|name| context.part(role, name)).transpose();
        let part = part_of(&spec.from)?;
        let into = spec.into.as_deref().map_or(Ok(None), part_of)?;
        let into = into.map(|place| (with_part(context, place, part), place.name));
        let wrong = |key: &str, value: &Value, expected: &str| {
            let recipe = &context.recipe.recipe;
            MergeError::Recipe(format!("{recipe}: {key} of {} is {value}, not {expected}", spec.names))
        };
        let (slice, fit) = (value("slice", &spec.slice)?, value("fit", &spec.fit)?);
        let (scale, dtype) = (value("scale", &spec.scale)?, value("dtype", &spec.dtype)?);
        let rule = TensorRule {
            spec,
            names,
            rename,
            adapter: adapter(context, spec)?,
            like: spec.like.as_ref().and_then(|like| like_of(context, like)),
            mapping: None,
            part,
            into,
            slice: parse_slice(&slice).map_err(|expected| wrong("slice", &slice, expected))?,
            fit: parse_fit(&fit).map_err(|expected| wrong("fit", &fit, expected))?,
            scale: parse_scale(&scale).map_err(|expected| wrong("scale", &scale, expected))?,
            dtype: parse_dtype(&dtype).map_err(|expected| wrong("dtype", &dtype, expected))?,
        };
        rule.scales_something(&context.recipe.recipe)?;
        // To fit a map takes seconds.
        let mapping = if rule.fit == Fit::Map { Some(mapping(context, spec)?) } else { None };
        out.push(TensorRule { mapping, ..rule });
    }
    Ok(out)
}

/// The parts of the model around `place` with a donor's part in it.
fn with_part(context: &Context<'_>, place: PartOf<'_>, part: Option<PartOf<'_>>) -> DonorParts {
    let host = place.model_parts();
    let language = part.filter(|_| place.name == "language").map(PartOf::model_parts);
    language.map_or_else(|| host.clone(), |new| host.with_language_of(new, &context.asked))
}

/// The tensor whose rows new ones should be like; `None` where the donor lacks it.
fn like_of(context: &Context<'_>, like: &SeamTensor) -> Option<TensorRef> {
    let donor = context.donor(&like.from)?;
    let (shard, tensor) = donor.checkpoint.tensor(&like.name)?;
    TensorRef::new(&donor.role, donor.checkpoint.source.path(), shard, tensor, None).ok()
}

/// The map that an entry with the fit `map` names.
fn mapping(context: &Context<'_>, spec: &TensorSpec) -> Result<WordMapping, MergeError> {
    let wrong = |what: &str| MergeError::Recipe(format!("{}: {what}", context.recipe.recipe));
    let missing = || wrong(&format!("fit of {} is map, and no `words` name two embeddings", spec.names));
    let words = spec.words.as_ref().ok_or_else(missing)?;
    let times = words.times.as_ref().map_or(Ok(Value::Null), |times| times.eval(&context.scope));
    let times = times.map_err(context.at(format!("times of {}", spec.names)))?;
    let by = parse_scale(&times);
    let by = by.map_err(|expected| wrong(&format!("times of {} is {times}, not {expected}", spec.names)))?;
    let found = context.fits.between(&words.from, &words.to);
    let map = (*found).as_ref().map(|fit| Box::new(fit.map.clone())).map_err(Clone::clone);
    Ok(WordMapping { map, rows: words.rows, times: by.unwrap_or(1.0) })
}

/// The adapter that an entry merges, with its tensors placed.
fn adapter(context: &Context<'_>, spec: &TensorSpec) -> Result<Option<MergedAdapter>, MergeError> {
    let Some(adapter) = &spec.adapter else { return Ok(None) };
    let turned = adapter.turned.as_ref().map_or(Ok(Value::Null), |turned| turned.eval(&context.scope));
    let turned = turned.map_err(context.at("turned"))?;
    let turned = match turned {
        Value::Null => Some(Vec::new()),
        Value::Array(names) => names.into_iter().map(|name| name.as_str().map(str::to_owned)).collect(),
        _ => None,
    };
    let turned = turned.ok_or_else(|| {
        MergeError::Recipe(format!("{}: turned of an adapter is not a list of names", context.recipe.recipe))
    })?;
    let (Some(base), Some(donor)) = (context.donor(&spec.from), context.donor(&adapter.from)) else { return Ok(None) };
    MergedAdapter::place(base, donor, turned, context.library).map(Some)
}

// Each parser takes the value of an expression, null when it is missing, and fails with what was expected.

fn parse_slice(value: &Value) -> Result<Option<[u64; 2]>, &'static str> {
    if value.is_null() {
        return Ok(None);
    }
    let expected = "a list of the first row and the number of rows";
    let items: Option<Vec<u64>> = value.as_array().and_then(|list| list.iter().map(Value::as_u64).collect());
    items.and_then(|items| items.try_into().ok()).map(Some).ok_or(expected)
}

fn parse_fit(value: &Value) -> Result<Fit, &'static str> {
    let known = |name: &str| Fit::ALL.into_iter().find(|fit| fit.name() == name);
    let expected = "copy, pad, map, grow-rows, sample-rows, mean-like, sampled-like, reinit or reinit-always";
    match value {
        Value::Null => Ok(Fit::Copy),
        value => value.as_str().and_then(known).ok_or(expected),
    }
}

#[expect(clippy::float_cmp, reason = "a factor of exactly 1 changes nothing")]
fn parse_scale(value: &Value) -> Result<Option<f64>, &'static str> {
    if value.is_null() {
        return Ok(None);
    }
    let scale = value.as_f64().filter(|scale| scale.is_finite() && *scale != 0.0);
    scale.map(|scale| Some(scale).filter(|scale| *scale != 1.0)).ok_or("a finite number other than 0")
}

fn parse_dtype(value: &Value) -> Result<Option<Dtype>, &'static str> {
    match value {
        Value::Null => Ok(None),
        Value::String(name) => Dtype::of_float_name(name).map(Some).ok_or("bfloat16, float16, float32 or float64"),
        _ => Err("bfloat16, float16, float32 or float64"),
    }
}

/// Position and shape of each tensor that the class has with the planned config.
///
/// Under its names of every loader, those of the loader that the config names first: `save_pretrained` of transformers 4.57
/// writes names that the classes of 4.47 have. `spelled` gives the name in the result of one that the checkpoint's layout has in
/// another way. A loader that does not read the text config knows no shape.
fn expected_shapes<'n>(
    library: &Library,
    config: Option<&Value>,
    names: impl Iterator<Item = &'n str>,
    evidence: &Evidence,
    spelled: &impl Fn(&str) -> Option<String>,
) -> HashMap<String, (usize, Vec<u64>)> {
    let Some(config) = config else { return HashMap::new() };
    let names: Vec<&str> = names.collect();
    let mut shapes = HashMap::new();
    for loader in std::iter::once(Loader::of_config(config)).chain(Loader::ALL) {
        let class = library.find(config, names.iter().copied(), loader);
        let class = class.filter(|class| !class.misses_text_config(config));
        let Some(expected) = class.and_then(|class| class.expect_given(config, evidence).ok()) else { continue };
        for (i, (name, tensor)) in expected.tensors.iter().enumerate() {
            for name in std::iter::once(name.clone()).chain(spelled(name)) {
                shapes.entry(name).or_insert_with(|| (i, tensor.shape.clone()));
            }
        }
    }
    shapes
}

/// The source of a tensor of `shape`, or the reason why the donor tensor cannot be used. `values` are those of a tensor that
/// starts again, or why they are not known.
fn source(
    taken: &TakenTensor<'_>,
    shape: &[u64],
    values: Option<Result<NewValues, String>>,
) -> Result<TensorExpr<TensorRef>, String> {
    let TakenTensor { donor, shard, tensor, rule, .. } = taken;
    if let Some(source) = rule.adapter.as_ref().and_then(|adapter| adapter.source(&tensor.name)) {
        return Ok(source.clone());
    }
    let of = TensorRef::new(&donor.role, donor.checkpoint.source.path(), shard, tensor, rule.slice)?;
    let starts = values.is_some();
    let scale = rule.scale_of(tensor);
    let changes = scale.is_some() || taken.dtype() != tensor.dtype;
    let is_replaced = matches!(rule.fit, Fit::MeanLike | Fit::SampledLike | Fit::Map);
    let fits = of.shape == shape && !starts && !is_replaced;
    if (changes || !(fits || rule.fit == Fit::Copy)) && !can_compute(tensor.dtype) {
        return Err(format!("values of type {} can only be copied", tensor.dtype));
    }
    let nests = nests(&of.shape, shape);
    let grows = nests && of.shape.iter().skip(1).eq(shape.iter().skip(1));
    let rows = shape.first().copied().unwrap_or_default();
    let (shape, dtype) = (shape.to_vec(), taken.dtype());
    let fitted = match rule.fit {
        _ if fits => TensorExpr::Stored(of),
        Fit::Copy => return Err(String::new()),
        Fit::Pad if !nests => return Err(CANNOT_SHRINK.to_owned()),
        Fit::GrowRows | Fit::SampleRows if !grows => return Err("only rows can be added".to_owned()),
        Fit::Pad => TensorExpr::Pad { of, shape },
        // Rounded once, after its factor.
        Fit::Map => {
            let mapping = rule.mapping.as_ref().ok_or("it has no map")?;
            return mapped(of, mapping, scale.unwrap_or(1.0), dtype);
        }
        Fit::MeanLike | Fit::SampledLike => {
            let like = rule.like.clone().ok_or("the tensor that its rows should be like is missing")?;
            if like.shape.len() != shape.len() || !like.shape.iter().skip(1).eq(shape.iter().skip(1)) {
                return Err(format!("rows of {}, {:?}, do not fit", like.name, like.shape));
            }
            let from = like.dtype;
            let made = TensorExpr::NewRows { like, rows, sampled: rule.fit == Fit::SampledLike, instead_of: of };
            return Ok(made.converted(from, scale, dtype));
        }
        Fit::GrowRows => TensorExpr::GrowRows { of, rows },
        Fit::SampleRows => TensorExpr::SampleRows { of, rows },
        // New values have the size that the class gives them.
        Fit::Reinit | Fit::ReinitAlways => {
            let values = values.transpose()?.ok_or(UNKNOWN_VALUES)?;
            return Ok(TensorExpr::Initialise { values, dtype, shape, instead_of: of });
        }
    };
    Ok(fitted.converted(tensor.dtype, scale, dtype))
}

/// A tensor in the space of another embedding.
fn mapped(of: TensorRef, mapping: &WordMapping, after: f64, to: Dtype) -> Result<TensorExpr<TensorRef>, String> {
    let values = match of.shape.len() {
        1 => Mapped::Point,
        _ if mapping.rows => Mapped::Rows,
        _ => Mapped::Columns,
    };
    Ok(TensorExpr::Map { of, values, before: mapping.times, after, to, map: mapping.map.clone()? })
}

/// Why `reinit` does not help.
const UNKNOWN_VALUES: &str = "the values that its class starts it with are not recorded in rules/initial-values.json, so it cannot be reinitialised";

/// Why `pad` does not help.
const CANNOT_SHRINK: &str = "padding cannot shrink a tensor";

/// The seam for a tensor with a shape mismatch.
fn misfit(context: &Context<'_>, taken: &TakenTensor<'_>, needed: Vec<u64>, why: &str) -> Seam {
    let TakenTensor { name, donor, tensor, rule, .. } = taken;
    let options = rule.spec.options.iter().map(|option| format!("--set {option}")).collect();
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
        options,
    }
}

/// Whether a tensor has the rank of `shape` and is at most as large in each dimension.
fn nests(from: &[u64], shape: &[u64]) -> bool {
    from.len() == shape.len() && from.iter().zip(shape).all(|(have, want)| have <= want)
}
