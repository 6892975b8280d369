//! The model card of a merge: what the donors' own cards state.

use std::collections::BTreeMap;

use super::manifest::DonorDigests;
use super::parts::Donor;
use super::{CARD, hub::HubOrigin};
use crate::knowledge::recipe::Recipe;
use crate::report::card::{Card, CardDonor, Licence};
use crate::surgery::plan::Plan;

/// Maximum number of bytes read of a donor's model card.
const CAP: u64 = 4 << 20;
/// Maximum number of lines of a front matter.
const LINES: usize = 2000;
/// Maximum length of a value, in bytes.
const VALUE: usize = 300;

/// The card of a merge of these donors.
pub(super) fn card(recipe: &Recipe, donors: &[Donor], digests: &BTreeMap<String, DonorDigests>, plan: &Plan) -> Card {
    let donor = |donor: &Donor| {
        let hub = digests.get(&donor.role).map_or_else(HubOrigin::default, |digests| digests.hub.clone());
        CardDonor {
            role: donor.role.clone(),
            base: hub.base().map(str::to_owned),
            revision: hub.revision,
            tensors: plan.tensors().filter(|(_, tensor)| tensor.source.main().donor == donor.role).count(),
            licence: licence(donor),
        }
    };
    Card { summary: recipe.summary.clone(), donors: donors.iter().map(donor).collect() }
}

/// The licence that the donor's own card states; `None` without a card, or when its front matter has none.
fn licence(donor: &Donor) -> Option<Licence> {
    let bytes = donor.checkpoint.source.read_own(&CARD, CAP).ok()?;
    let fields = front_matter(&String::from_utf8_lossy(&bytes));
    let field = |key: &str| fields.get(key).cloned();
    Some(Licence { id: field("license")?, name: field("license_name"), link: field("license_link") })
}

/// The values of the front matter of a card that are scalars or lists with one scalar, by key; anything else in YAML is
/// skipped.
fn front_matter(text: &str) -> BTreeMap<String, String> {
    let mut fields = BTreeMap::new();
    let mut lines = text.trim_start_matches('\u{feff}').lines();
    if lines.next().map(str::trim_end) != Some("---") {
        return fields;
    }
    let lines: Vec<&str> = lines.take(LINES).collect();
    let Some(end) = lines.iter().position(|line| line.trim_end() == "---") else { return fields };
    let mut list: Option<(&str, Vec<String>)> = None;
    for line in lines.into_iter().take(end) {
        if let (Some(item), Some((_, items))) = (line.trim_start().strip_prefix("- "), &mut list) {
            items.extend(scalar(item));
            continue;
        }
        keep_single(&mut fields, list.take());
        // A key of a nested object is indented.
        if let Some((key, value)) = line.split_once(':').filter(|_| !line.starts_with([' ', '\t', '#'])) {
            match value.trim() {
                "" => list = Some((key, Vec::new())),
                value => fields.extend(scalar(value).map(|value| (key.to_owned(), value))),
            }
        }
    }
    keep_single(&mut fields, list);
    fields
}

fn keep_single(fields: &mut BTreeMap<String, String>, list: Option<(&str, Vec<String>)>) {
    if let Some((key, items)) = list
        && let [item] = items.as_slice()
    {
        fields.insert(key.to_owned(), item.clone());
    }
}

/// The text of a plain or quoted scalar on one line; `None` for other YAML, such as lists, objects and block scalars.
fn scalar(value: &str) -> Option<String> {
    let value = value.trim();
    let text = match value.chars().next()? {
        quote @ ('"' | '\'') => {
            let inner = value.strip_prefix(quote)?;
            let (inner, rest) = inner.split_once(quote)?;
            let is_end = rest.trim().is_empty() || rest.trim_start().starts_with('#');
            (is_end && !inner.contains('\\')).then_some(inner)?
        }
        '[' | '{' | '|' | '>' | '&' | '*' | '!' | '%' | '@' | '`' | '#' => return None,
        _ => value.split(" #").next()?.trim(),
    };
    let is_plain = !text.is_empty() && text.len() <= VALUE && !text.chars().any(char::is_control);
    is_plain.then(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::front_matter;

    #[test]
    fn scalars_and_lists_of_one_are_read() {
        let card = "---\nlicense: llama2  # see LICENSE\nlicense_name: \"a: b\"\nbase_model:\n- org/one\ntags:\n  - a\n  - b\nmodel-index:\n- name: x\n  results: 1\nlicense_link: 'x#y'\nlanguage: [en]\nlong: >\n  text\n---\nlicense: mit\n";
        let fields = front_matter(card);
        let field = |key: &str| fields.get(key).map(String::as_str);
        assert_eq!(field("license"), Some("llama2"));
        assert_eq!(field("license_name"), Some("a: b"));
        assert_eq!(field("license_link"), Some("x#y"));
        assert_eq!(field("base_model"), Some("org/one"));
        for key in ["tags", "language", "long", "results"] {
            assert_eq!(field(key), None, "{key}");
        }
    }

    #[test]
    fn text_without_a_front_matter_has_no_fields() {
        for text in ["", "license: mit", "---\nlicense: mit\n", "----\nlicense: mit\n---", " ---\nlicense: mit\n---\n"]
        {
            assert!(front_matter(text).is_empty(), "{text:?}");
        }
        let long = format!("---\nlicense: {}\n---\n", "x".repeat(1000));
        assert!(front_matter(&long).is_empty());
        assert!(front_matter("---\nlicense: a\u{1b}[31m\n---\n").is_empty());
        assert!(front_matter("---\r\nlicense: mit\r\n---\r\n").contains_key("license"));
    }
}
