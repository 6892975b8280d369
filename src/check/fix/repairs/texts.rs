//! Repairs of JSON as such.

use crate::check::fix::{Edit, Site, clamped};

/// Drops the later of two members that are equal, key and value.
pub(super) fn drop_equal_key(site: &Site<'_>) -> Option<Vec<Edit>> {
    let place = site.place()?;
    let (file, pointer, key) = (place.file.clone()?, place.pointer.as_deref()?, place.span.clone()?);
    let splice = site.checkpoint().document(&file)?.remove_at(pointer, key.start)?;
    Some(vec![Edit::Splice { file, range: splice.range, text: splice.text }])
}

/// Replaces an infinity by the largest float32 of its sign.
pub(super) fn clamp_infinity(site: &Site<'_>) -> Option<Vec<Edit>> {
    let place = site.place()?;
    let text = clamped(site.fault?.detail.get("literal")?.as_str()?)?.to_string();
    Some(vec![Edit::Splice { file: place.file.clone()?, range: place.span.clone()?, text }])
}

/// Puts a string in double quotes that is in single ones.
pub(super) fn quote_string(site: &Site<'_>) -> Option<Vec<Edit>> {
    let place = site.place()?;
    let (file, range) = (place.file.clone()?, place.span.clone()?);
    let text = site.checkpoint().document(&file)?.text.as_deref()?;
    let inner = text.get(range.clone())?.strip_prefix('\'')?.strip_suffix('\'')?;
    let mut quoted = String::from('"');
    let mut chars = inner.chars();
    while let Some(c) = chars.next() {
        match c {
            '"' => quoted.push_str("\\\""),
            // JSON has every escape but this one.
            '\\' => match chars.next()? {
                '\'' => quoted.push('\''),
                other => quoted.extend(['\\', other]),
            },
            other => quoted.push(other),
        }
    }
    quoted.push('"');
    Some(vec![Edit::Splice { file, range, text: quoted }])
}

/// Cuts the NUL bytes off that a file ends with.
pub(super) fn cut_nul_bytes(site: &Site<'_>) -> Option<Vec<Edit>> {
    let file = site.place()?.file.clone()?;
    let document = site.checkpoint().document(&file)?;
    let text = document.text.as_deref()?;
    let body = text.trim_end_matches('\0');
    let whole = document.value.is_some() && !body.contains('\0') && !body.trim().is_empty();
    whole.then(|| vec![Edit::Splice { file, range: body.len()..text.len(), text: String::new() }])
}
