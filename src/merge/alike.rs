//! Compares a part with the one whose place it takes, where the model keeps its class and its tokenizer.

use super::context::Context;
use super::error::MergeError;
use super::parts::{PartOf, value_of};
use crate::checkpoint::files;
use crate::checkpoint::tokenizer::Comparison;
use crate::checkpoint::{Tokenizer, escape};
use crate::knowledge::recipe::{AlikeSpec, Exchange};

/// Special tokens whose ids the weights were trained with. Padding is masked, and models are often trained with another token.
const TRAINED: [&str; 3] = ["bos_token", "eos_token", "unk_token"];

/// Characters of a token that an error quotes.
const TOKEN_CAP: usize = 40;

/// Fails when a part that comes to stand in a model is of another model type, or was trained with another tokenizer; the error
/// names what differs and the command that exchanges the part. Called before the plan. Returns a note on what was not compared.
pub(super) fn check(context: &Context<'_>) -> Result<Option<String>, MergeError> {
    let Some(spec) = &context.recipe.alike else { return Ok(None) };
    let name = spec.part.try_render(&context.scope).map_err(context.at("part"))?;
    let (place, new) = (context.part(&spec.into, &name)?, context.part(&spec.from, &name)?);
    let kind = place.model_type().zip(new.model_type()).filter(|(one, other)| one != other);
    let mut differences: Vec<String> =
        kind.into_iter().map(|(one, other)| format!("its model type is {other}, not {one}")).collect();
    let mut note = None;
    if spec.reads_text.iter().any(|part| part == place.name) {
        match tokenizers(place, new) {
            Compared::Tokenizers(difference) => differences.extend(difference),
            Compared::Configs(difference) => {
                differences.extend(difference);
                note = Some(format!(
                    "The {} donor has no vocabulary that could be compared: whether it was trained with the tokenizer of the model is not known.",
                    spec.from
                ));
            }
        }
    }
    if differences.is_empty() { Ok(note) } else { Err(refusal(context, spec, place, new, &differences.join(", and "))) }
}

fn refusal(context: &Context<'_>, spec: &AlikeSpec, place: PartOf<'_>, new: PartOf<'_>, why: &str) -> MergeError {
    let role = |role: &str| context.donor(role).map(|donor| donor.checkpoint.source.path().display().to_string());
    let command = |exchange: &Exchange| {
        let donors = exchange.roles.iter().filter_map(|(option, of)| Some(format!(" --donor {option}={}", role(of)?)));
        format!(
            "; this command exchanges it: ckpt-doctor build-merged --recipe {}{} --out OUT",
            exchange.recipe,
            donors.collect::<String>()
        )
    };
    let exchange = spec.otherwise.iter().find(|exchange| exchange.part == place.name).map(command);
    MergeError::Donor(format!(
        "{} cannot take the place of the {} part of {}: {why}; {} keeps the class and the tokenizer of the model{}",
        new.donor().checkpoint.source.path().display(),
        place.name,
        place.donor().checkpoint.source.path().display(),
        context.recipe.recipe,
        exchange.unwrap_or_default()
    ))
}

/// What a part that reads text was compared by, and the difference in words.
enum Compared {
    /// Vocabularies and special tokens.
    Tokenizers(Option<String>),
    /// The ids of special tokens in the configs.
    Configs(Option<String>),
}

fn tokenizers(place: PartOf<'_>, new: PartOf<'_>) -> Compared {
    let (model, part) = (&place.donor().checkpoint.tokenizer, &new.donor().checkpoint.tokenizer);
    match model.compare(part) {
        Comparison::Unknown => Compared::Configs(config_ids(place, new)),
        Comparison::Equal => Compared::Tokenizers(special_tokens(model, part)),
        Comparison::Different { token, own, others, count } => {
            let token = escape(&token, TOKEN_CAP);
            let differs = match (own, others) {
                (Some(own), Some(others)) => {
                    format!("`{token}` is {others} in its tokenizer and {own} in that of the model")
                }
                (Some(own), None) => format!("its tokenizer lacks `{token}`, {own} in that of the model"),
                (None, others) => {
                    format!(
                        "its tokenizer has `{token}`, {}, which that of the model lacks",
                        others.unwrap_or_default()
                    )
                }
            };
            Compared::Tokenizers(Some(format!("{differs} ({})", super::count(count, "token differs", "tokens differ"))))
        }
    }
}

/// The first special token that both tokenizers name, and name otherwise.
fn special_tokens(model: &Tokenizer, part: &Tokenizer) -> Option<String> {
    let token = |tokenizer: &Tokenizer, name: &str| {
        tokenizer.special_tokens.iter().find(|(attribute, _)| attribute == name).map(|(_, token)| token.clone())
    };
    TRAINED.into_iter().find_map(|name| {
        let (own, others) = token(model, name).zip(token(part, name)).filter(|(own, others)| own != others)?;
        Some(format!(
            "its {name} is `{}`, and that of the model `{}`",
            escape(&others, TOKEN_CAP),
            escape(&own, TOKEN_CAP)
        ))
    })
}

/// The first id of a special token that both state, and state otherwise: in the config of the part, or for generation.
fn config_ids(place: PartOf<'_>, new: PartOf<'_>) -> Option<String> {
    ["bos_token_id", "eos_token_id"].into_iter().find_map(|key| {
        let id = |part: PartOf<'_>| {
            let generation = value_of(&part.donor().checkpoint, files::GENERATION_CONFIG);
            let places = [Some(part.config()), generation].into_iter().flatten();
            places.filter_map(|place| place.get(key)).find(|id| !id.is_null()).cloned()
        };
        let (own, others) = id(place).zip(id(new)).filter(|(own, others)| own != others)?;
        Some(format!("its {key} is {others}, and that of the model {own}"))
    })
}
