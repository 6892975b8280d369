//! Functions of recipes that compare the weights of donors, besides those of [`super::context`].

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde_json::{Value, json};

use super::dtypes;
use super::parts::{Donor, DonorParts, PartOf};
use crate::check::default_template;
use crate::knowledge::scales::Scales;
use crate::knowledge::{Loader, Scope, source};
use crate::surgery::rms::rms;
use crate::surgery::tensor_ref::TensorRef;

/// Adds `dtype`, `image_fold`, `row_scale`, `row_norm`, `tried`, `head_factor` and `chat_template`; the result is for the loaders
/// that are `asked` for, or any.
pub(super) fn register(scope: &mut Scope<'static>, donors: &[Donor], asked: &BTreeSet<Loader>, scales: &Scales) {
    let dtypes: BTreeMap<String, &'static str> = donors
        .iter()
        .filter_map(|donor| Some((donor.role.clone(), donor.checkpoint.float_of_most_bytes()?.float_name()?)))
        .collect();
    let of_role = dtypes.clone();
    scope.function1("dtype", move |role| of_role.get(role).map_or(Value::Null, |name| json!(name)));
    let configs: Arc<BTreeMap<String, Value>> =
        Arc::new(donors.iter().map(|donor| (donor.role.clone(), donor.config.clone())).collect());
    let (of_roles, of_models) = (Arc::clone(&configs), scales.clone());
    let loaders: Vec<Loader> = Loader::ALL.into_iter().filter(|l| asked.is_empty() || asked.contains(l)).collect();
    scope.function2("image_fold", move |host, guest| match (of_roles.get(host), of_roles.get(guest)) {
        (Some(host), Some(guest)) => image_fold(&of_models, host, guest, &loaders),
        _ => Value::Null,
    });
    let templates: BTreeMap<String, String> = donors
        .iter()
        .filter_map(|donor| Some((donor.role.clone(), default_template(&donor.checkpoint)?.to_owned())))
        .collect();
    let turns: BTreeMap<String, String> = donors
        .iter()
        .filter_map(|donor| {
            Some((donor.role.clone(), donor.parts.as_ref().map(DonorParts::model)?.image_turn.clone()?))
        })
        .collect();
    scope.function2("chat_template", move |guest, host| {
        let with_image = |template: &String| {
            turns.get(host).map_or_else(|| template.clone(), |turn| with_image_turn(template, turn))
        };
        templates.get(guest).map_or(Value::Null, |template| json!(with_image(template)))
    });
    let (of_roles, of_models) = (Arc::clone(&configs), scales.clone());
    scope.function1("head_factor", move |role| {
        let stated = of_roles.get(role).and_then(|config| of_models.of_logits(config));
        let (factor, key) = stated.unwrap_or((1.0, ""));
        json!({ "factor": factor, "key": key })
    });
    let embeddings: BTreeMap<String, (TensorRef, f64)> = donors
        .iter()
        .filter_map(|donor| {
            Some((donor.role.clone(), (embedding(donor)?, scales.of_rows(&donor.config, Loader::NEWEST))))
        })
        .collect();
    scope.function1("row_norm", move |role| {
        let norm = embeddings.get(role).and_then(|(of, scale)| row_norm(of, *scale));
        norm.map_or(Value::Null, |norm| json!(norm))
    });
    // The pairs that tests/peer/surgery.py ran: versions of transformers by the model types of host and part.
    let tried: BTreeMap<String, BTreeMap<String, Value>> =
        source::text("tried-pairs.json").and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default();
    scope.function2("tried", move |host, part| {
        tried.get(host).and_then(|parts| parts.get(part)).cloned().unwrap_or_else(|| json!([]))
    });
    let of_models = scales.clone();
    scope.function1("row_scale", move |role| {
        let scale = configs.get(role).map(|config| of_models.of_rows(config, Loader::NEWEST));
        scale.map_or(Value::Null, |scale| json!(dtypes::round(scale, dtypes.get(role).copied())))
    });
}

/// The embedding of a donor's language model.
pub(super) fn embedding(donor: &Donor) -> Option<TensorRef> {
    let name = PartOf::find(donor, "language")?.name_of("model.embed_tokens.weight")?;
    let (shard, tensor) = donor.checkpoint.tensor(&name)?;
    TensorRef::new(&donor.role, donor.checkpoint.source.path(), shard, tensor, None).ok()
}

/// The norm of rows of an embedding of which the class multiplies each by `scale`, to four digits; `None` where it cannot be told,
/// or is 0.
fn row_norm(of: &TensorRef, scale: f64) -> Option<f64> {
    let width = u32::try_from(*of.shape.get(1)?).ok()?;
    let norm = rms(of).ok().flatten()? * f64::from(width).sqrt() * scale;
    // Enough for a size, and reports stay short.
    format!("{norm:.3e}").parse().ok().filter(|norm: &f64| norm.is_normal())
}

/// The factor that keeps image features as large as in the host when its class has the language model of the guest, with those
/// of the loaders for which it is right and those that need none. Features of the host are as large as under the version of
/// transformers that wrote its config. Versions that do not load the host's class are left out.
fn image_fold(scales: &Scales, host: &Value, guest: &Value, loaders: &[Loader]) -> Value {
    let trained = scales.of_images(host, host, Loader::of_config(host));
    let factor = |loader: Loader| {
        let factor = trained / scales.of_images(host, guest, loader);
        // Square roots do not cancel to the last bit of binary64.
        dtypes::round(factor, Some("float32"))
    };
    let needs = |loader: &Loader| (factor(*loader) - 1.0).abs() > f64::EPSILON;
    let loads = |loader: &Loader| scales.loads(host, *loader);
    let (with, without): (Vec<Loader>, Vec<Loader>) = loaders.iter().copied().filter(loads).partition(needs);
    let versions = |loaders: &[Loader]| loaders.iter().map(|loader| loader.version()).collect::<Vec<_>>();
    let common = with.first().map_or(1.0, |loader| factor(*loader));
    json!({ "factor": common, "trained": trained, "with": versions(&with), "without": versions(&without) })
}

/// A chat template in front of which messages with parts become messages of text, with `turn` in place of each image. Templates
/// of language models take text alone, and processors look for the text of an image in what a template writes.
fn with_image_turn(template: &str, turn: &str) -> String {
    let before = source::text("image-turn.jinja").unwrap_or_default();
    // A string of JSON is one of Jinja.
    [before.trim_end().replace("IMAGE_TURN", &json!(turn).to_string()).as_str(), template].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_that_were_tried_have_versions() {
        let text = source::text("tried-pairs.json").unwrap();
        let pairs: BTreeMap<String, BTreeMap<String, Vec<String>>> = serde_json::from_str(text).unwrap();
        let known = |versions: &Vec<String>| versions.iter().all(|v| Loader::ALL.iter().any(|l| l.version() == v));
        assert!(pairs.values().flat_map(BTreeMap::values).all(|versions| !versions.is_empty() && known(versions)));
        assert!(pairs["llava"].contains_key("qwen2") && !pairs["llava"].contains_key("llava"));
    }

    #[test]
    fn image_features_stay_as_large_as_they_were_trained() {
        let scales = Scales::embedded().unwrap();
        let host = |model_type: &str, text: &str| {
            json!({ "model_type": model_type, "transformers_version": "4.47.0",
                "text_config": { "model_type": text, "hidden_size": 64 } })
        };
        let guest = |text: &str| json!({ "model_type": text, "hidden_size": 64 });
        let fold = |host: &Value, guest: &Value| {
            let mut fold = image_fold(&scales, host, guest, &Loader::ALL);
            assert_eq!(
                fold.as_object_mut().unwrap().remove("trained"),
                Some(json!(scales.of_images(host, host, Loader::V4_47_0)))
            );
            fold
        };
        let of = |factor: f64, with: &[&str], without: &[&str]| json!({ "factor": factor, "with": with, "without": without });
        let all = ["4.47.0", "4.57.6", "5.23.0"];
        for (host, guest, expected) in [
            (host("paligemma", "gemma"), guest("gemma"), of(1.0, &[], &all)),
            (host("paligemma", "gemma"), guest("llama"), of(8.0, &["4.47.0", "4.57.6"], &["5.23.0"])),
            // transformers 5 does not load its code.
            (host("spatialvla", "gemma2"), guest("mistral"), of(8.0, &all[..2], &[])),
            (host("spatialvla", "gemma2"), guest("gemma2"), of(1.0, &[], &all[..2])),
            // Gemma multiplied the features of this host.
            (host("llava", "gemma"), guest("llama"), of(8.0, &all, &[])),
            (host("llava", "llama"), guest("mistral"), of(1.0, &[], &all)),
        ] {
            assert_eq!(fold(&host, &guest), expected, "{host} {guest}");
        }
    }
}
