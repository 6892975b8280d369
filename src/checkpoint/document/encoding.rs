//! Decodes the bytes of a document, and reports an encoding other than UTF-8.

use std::borrow::Cow;

use crate::checkpoint::{Fault, FaultKind, Place};

/// Text of a document, and whether it equals the bytes of the file.
pub(super) struct Decoded<'a> {
    pub(super) text: Cow<'a, str>,
    /// Whether `text` is the file's bytes unchanged.
    pub(super) verbatim: bool,
    pub(super) faults: Vec<Fault>,
}

/// Decodes as UTF-8, or as UTF-16 or UTF-32 when the bytes show it.
pub(super) fn decode<'a>(name: &str, bytes: &'a [u8]) -> Decoded<'a> {
    if let Some((encoding, text)) = wide(bytes) {
        let fault = Fault::new(FaultKind::WrongEncoding).at(Place::file(name)).with("encoding", encoding);
        return Decoded { text: Cow::Owned(text), verbatim: false, faults: vec![fault] };
    }
    match std::str::from_utf8(bytes) {
        Ok(text) => {
            let mut faults = Vec::new();
            if text.starts_with('\u{feff}') {
                faults.push(Fault::new(FaultKind::ByteOrderMark).at(Place::file(name).span(0..3)));
            }
            Decoded { text: Cow::Borrowed(text), verbatim: true, faults }
        }
        Err(error) => {
            let fault = Fault::invalid_utf8(name, bytes, error.valid_up_to());
            Decoded { text: String::from_utf8_lossy(bytes), verbatim: false, faults: vec![fault] }
        }
    }
}

/// Decodes UTF-16 and UTF-32, recognised by a byte-order mark or by the positions of NUL bytes in ASCII text.
pub(super) fn wide(bytes: &[u8]) -> Option<(&'static str, String)> {
    let (encoding, skip) = match bytes {
        [0xff, 0xfe, 0, 0, ..] => ("UTF-32LE", 4),
        [0, 0, 0xfe, 0xff, ..] => ("UTF-32BE", 4),
        [0xff, 0xfe, ..] => ("UTF-16LE", 2),
        [0xfe, 0xff, ..] => ("UTF-16BE", 2),
        [1..=255, 0, 0, 0, ..] => ("UTF-32LE", 0),
        [0, 0, 0, 1..=255, ..] => ("UTF-32BE", 0),
        [1..=255, 0, 1..=255, 0, ..] => ("UTF-16LE", 0),
        [0, 1..=255, 0, 1..=255, ..] => ("UTF-16BE", 0),
        _ => return None,
    };
    let body = bytes.get(skip..).unwrap_or_default();
    let text = if encoding.starts_with("UTF-32") {
        let little = encoding.ends_with("LE");
        body.as_chunks::<4>()
            .0
            .iter()
            .map(|c| if little { u32::from_le_bytes(*c) } else { u32::from_be_bytes(*c) })
            .map(|u| char::from_u32(u).unwrap_or(char::REPLACEMENT_CHARACTER))
            .collect()
    } else {
        let little = encoding.ends_with("LE");
        let units = body.as_chunks::<2>().0.iter();
        char::decode_utf16(units.map(|c| if little { u16::from_le_bytes(*c) } else { u16::from_be_bytes(*c) }))
            .map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER))
            .collect()
    };
    Some((encoding, text))
}
