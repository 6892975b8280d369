//! The model card of a merge: `README.md` of the result, with the front matter that the Hugging Face Hub reads.
//!
//! Keys of the front matter: <https://huggingface.co/docs/hub/model-cards>.

use std::fmt::Write as _;

use super::format::{name, plural, sentence};
use super::markdown::{code, sentences, table, text, text_name, tokens_used, training, usage};
use super::model::MergeReport;

/// The facts of a model card that the record of the merge does not contain.
#[derive(Debug, Clone, Default)]
pub(crate) struct Card {
    /// What the recipe makes, as one line.
    pub summary: String,
    /// The donors.
    pub donors: Vec<CardDonor>,
}

/// A donor on a model card.
#[derive(Debug, Clone, Default)]
pub(crate) struct CardDonor {
    /// Role in the recipe.
    pub role: String,
    /// Repository on the Hub: the donor's own, or the one that its config names.
    pub base: Option<String>,
    /// Commit of the donor's own repository.
    pub revision: Option<String>,
    /// Number of tensors of the result that were made from this donor.
    pub tensors: usize,
    /// Licence that the donor's own card states.
    pub licence: Option<Licence>,
}

/// The licence in the front matter of a model card.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Licence {
    /// `license`: an identifier of the Hub, such as `apache-2.0`.
    pub id: String,
    /// `license_name`, for the identifier `other`.
    pub name: Option<String>,
    /// `license_link`.
    pub link: Option<String>,
}

/// Renders the card; `merge` is the record without the names of directories.
pub(crate) fn render(card: &Card, merge: &MergeReport) -> String {
    let mut out = String::new();
    front_matter(&mut out, card);
    let _ok =
        writeln!(out, "\n# Merged checkpoint\n\nParts of several checkpoints: {}.", text(&sentence(&card.summary)));
    let (tool, recipe) = (concat!(env!("CARGO_PKG_NAME"), " ", env!("CARGO_PKG_VERSION")), text_name(&merge.recipe));
    let _ok = writeln!(out, "\nMade by {tool} with the recipe {recipe}. No weights were averaged or trained.");
    let unknown = || "not stated".to_owned();
    let rows: Vec<_> = card
        .donors
        .iter()
        .map(|donor| {
            [
                text_name(&donor.role),
                donor.base.as_deref().map_or_else(unknown, |base| code(&name(base))),
                donor.revision.as_deref().map_or_else(unknown, |revision| code(&name(revision))),
                donor.licence.as_ref().map_or_else(unknown, licence),
                plural(donor.tensors, "tensor"),
            ]
        })
        .collect();
    table(&mut out, ["donor", "repository", "revision", "licence", "supplies"], &rows, usize::MAX);
    usage(&mut out, merge);
    training(&mut out, merge);
    tokens_used(&mut out, merge);
    sentences(&mut out, "Notes", &merge.notes, usize::MAX);
    let _ok = writeln!(
        out,
        "\n## Files\n\n`merge-report.md` lists what was changed. `merge-manifest.json` has the digest of every file and \
         tensor; `ckpt-doctor verify` compares the directory with it."
    );
    out
}

fn front_matter(out: &mut String, card: &Card) {
    // A JSON string is a YAML string.
    let quoted = |text: &str| serde_json::Value::from(text).to_string();
    out.push_str("---\n");
    let mut bases: Vec<&str> = card.donors.iter().filter_map(|donor| donor.base.as_deref()).collect();
    bases.sort_unstable();
    bases.dedup();
    if !bases.is_empty() {
        out.push_str("base_model:\n");
        for base in bases {
            let _ok = writeln!(out, "- {}", quoted(base));
        }
    }
    let licences: Vec<Option<&Licence>> = card.donors.iter().map(|donor| donor.licence.as_ref()).collect();
    match licences.split_first() {
        Some((Some(first), rest)) if rest.iter().all(|other| *other == Some(*first)) => {
            let _ok = writeln!(out, "license: {}", quoted(&first.id));
            for (key, value) in [("license_name", &first.name), ("license_link", &first.link)] {
                if let Some(value) = value {
                    let _ok = writeln!(out, "{key}: {}", quoted(value));
                }
            }
        }
        _ if licences.iter().any(Option::is_some) => out.push_str("license: other\n"),
        _ => {}
    }
    out.push_str("library_name: transformers\ntags:\n- merge\n---\n");
}

fn licence(licence: &Licence) -> String {
    let parts = [Some(&licence.id), licence.name.as_ref(), licence.link.as_ref()];
    let parts: Vec<String> = parts.into_iter().flatten().map(|part| code(&name(part))).collect();
    parts.join(" ")
}
