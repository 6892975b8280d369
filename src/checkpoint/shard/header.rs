//! Reads a safetensors header, and reports all of its faults with the names of their tensors.

use std::collections::{BTreeMap, HashMap};

use sha2::{Digest as _, Sha256};

use super::entry::HeaderEntry;
use super::{MAX_HEADER, Shard, ShardFormat, layout};
use crate::checkpoint::budget::Budget;
use crate::checkpoint::fault::Faults;
use crate::checkpoint::lfs::LfsPointer;
use crate::checkpoint::scan::{ScanError, ScanErrorKind, Scanner, Token};
use crate::checkpoint::sniff::looks_like;
use crate::checkpoint::text::{escape, hex};
use crate::checkpoint::{Fault, FaultKind};

mod fields;

/// `format` values that transformers accepts. Source: `load_state_dict` in transformers 4.47.0.
pub(crate) const FORMATS: [&str; 4] = ["pt", "tf", "flax", "mlx"];

impl Shard {
    /// Reads a header from the first bytes of a file of `file_len` bytes.
    ///
    /// `head` must contain the length field and the header it states, if the file does. For a file of another format,
    /// the first few hundred bytes are enough to recognise it.
    #[must_use]
    pub fn parse(name: impl Into<String>, file_len: u64, head: &[u8]) -> Self {
        Self::parse_within(name, file_len, head, &mut Budget::default())
    }

    /// Counts the entries of a header, for a shard of `file_len` bytes that is not read because the checkpoint is too large.
    pub(super) fn count_entries(name: &str, file_len: u64, head: &[u8]) -> Self {
        let shard = Self { file_len, ..Self::over_budget(name) };
        let further = frame(&shard, head).map_or(0, |(header, _)| count(header));
        Self { further, ..shard }
    }

    /// As [`Self::parse`], with the budget of the checkpoint: a header that needs more than is left is abandoned.
    pub(super) fn parse_within(name: impl Into<String>, file_len: u64, head: &[u8], budget: &mut Budget) -> Self {
        let shard = Self { name: name.into(), file_len, unread: true, ..Self::default() };
        parse(shard, head, budget)
    }
}

/// Fills in `shard`, which already has its name and length, from the first bytes of the file.
fn parse(mut shard: Shard, head: &[u8], budget: &mut Budget) -> Shard {
    let (header, data_start) = match frame(&shard, head) {
        Ok(frame) => frame,
        Err(fault) => {
            shard.faults.push(*fault);
            return shard;
        }
    };
    shard.data_start = data_start;
    let header_sha256 = hex(&Sha256::digest(head.get(..header.len().saturating_add(8)).unwrap_or(head)));
    shard.format = ShardFormat::Safetensors { metadata: None, header_sha256 };

    let mut faults = Faults::default();
    let Some(text) = header_text(&shard, header, &mut faults) else {
        shard.faults = faults.into_vec();
        return shard;
    };
    let scanner = Scanner::strict(text, 0);
    let mut reader =
        HeaderReader { shard: &shard, scanner, faults, entries: Vec::new(), metadata: HeaderMetadata::Absent, budget };
    let error = reader.object().err();
    let HeaderReader { mut faults, entries, metadata, scanner, .. } = reader;
    if let Some(ScanError { kind: ScanErrorKind::Syntax(reason), span }) = scanner.refused {
        faults.push(not_json(&shard, reason, span.start));
    }
    let is_too_large = error.as_ref().is_some_and(|error| error.kind == ScanErrorKind::Syntax(TOO_LARGE));
    // Text after the object is padding; any other error leaves entries unread.
    let unread = error.as_ref().is_some_and(|error| error.kind != ScanErrorKind::Trailing);
    let error = error.filter(|_| !is_too_large);
    faults.extend(error.map(|error| scan_fault(&shard, text, error)));
    if !unread {
        check_format(&shard, &metadata, &mut faults);
    }
    shard.unread = unread;
    if let (ShardFormat::Safetensors { metadata, .. }, HeaderMetadata::Strings(strings)) = (&mut shard.format, metadata)
    {
        *metadata = Some(strings);
    }
    let entries = without_duplicates(&shard, entries, &mut faults);
    layout::check(&shard, &entries, &mut faults);
    shard.tensors.reserve_exact(entries.len());
    for entry in entries {
        match entry.into_tensor() {
            Ok(tensor) => shard.tensors.push(tensor),
            Err(name) => shard.unreadable.push(name),
        }
    }
    if is_too_large {
        let kept = shard.tensors.len().saturating_add(shard.unreadable.len());
        shard.further = count(header).saturating_sub(u64::try_from(kept).unwrap_or(u64::MAX));
    }
    shard.faults = faults.into_vec();
    shard
}

/// Number of tensors that a header lists. Nothing is kept of them, and the text may be malformed.
fn count(header: &[u8]) -> u64 {
    let (mut depth, mut count) = (0_u64, 0_u64);
    let mut key: &[u8] = b"";
    let mut at = 0_usize;
    while let Some(byte) = header.get(at) {
        match byte {
            b'"' => {
                let rest = header.get(at.saturating_add(1)..).unwrap_or_default();
                let len = string_len(rest);
                if depth == 1 {
                    key = rest.get(..len).unwrap_or_default();
                }
                at = at.saturating_add(len).saturating_add(1);
            }
            b'{' | b'[' => {
                depth = depth.saturating_add(1);
                count = count.saturating_add(u64::from(depth == 2 && key != b"__metadata__"));
            }
            b'}' | b']' => depth = depth.saturating_sub(1),
            _ => {}
        }
        at = at.saturating_add(1);
    }
    count
}

/// Bytes before the quote that ends a string.
fn string_len(text: &[u8]) -> usize {
    let mut is_escaped = false;
    let end = text.iter().position(|byte| {
        let ends = *byte == b'"' && !is_escaped;
        is_escaped = *byte == b'\\' && !is_escaped;
        ends
    });
    end.unwrap_or(text.len())
}

/// The header as text, without a byte-order mark; `None` when it is not UTF-8.
fn header_text<'h>(shard: &Shard, header: &'h [u8], faults: &mut Faults) -> Option<&'h str> {
    let bare = header.strip_prefix(b"\xef\xbb\xbf");
    if bare.is_some() {
        faults.push(padding(shard, "a byte-order mark"));
    }
    match std::str::from_utf8(bare.unwrap_or(header)) {
        Ok(text) => Some(text),
        Err(error) => {
            faults.push(Fault::new(FaultKind::HeaderNotUtf8).at(shard.place()).with("offset", error.valid_up_to()));
            None
        }
    }
}

/// The fault for the error that ended the read of the object.
fn scan_fault(shard: &Shard, text: &str, error: ScanError) -> Fault {
    let start = error.span.start;
    match error.kind {
        ScanErrorKind::Trailing => {
            let rest = text.get(error.span).unwrap_or_default();
            padding(
                shard,
                match rest.trim_start().chars().next() {
                    Some('\0') => "NUL bytes",
                    Some('{') => "a second object",
                    _ => "other bytes",
                },
            )
        }
        ScanErrorKind::TooDeep => Fault::new(FaultKind::HeaderTooDeep).at(shard.place()).with("offset", start),
        ScanErrorKind::Syntax(TOO_MANY) => {
            Fault::new(FaultKind::JsonTooManyValues).at(shard.place()).with("cap", MAX_ENTRIES)
        }
        ScanErrorKind::Syntax(reason) => not_json(shard, reason, start),
    }
}

fn not_json(shard: &Shard, reason: &str, offset: usize) -> Fault {
    Fault::new(FaultKind::HeaderNotJson).at(shard.place()).with("reason", reason).with("offset", offset)
}

fn padding(shard: &Shard, what: &str) -> Fault {
    Fault::new(FaultKind::HeaderPaddingNotSpaces).at(shard.place()).with("what", what)
}

/// The header's bytes and the start of the data region, if the length field is valid.
fn frame<'a>(shard: &Shard, head: &'a [u8]) -> Result<(&'a [u8], u64), Box<Fault>> {
    let fault = |kind| Fault::new(kind).at(shard.place());
    let file_len = shard.file_len;
    if file_len == 0 {
        return Err(fault(FaultKind::EmptyFile).into());
    }
    let whole = u64::try_from(head.len()).is_ok_and(|len| len == file_len);
    if let Some(pointer) = LfsPointer::parse(head).filter(|_| whole) {
        return Err(fault(FaultKind::LfsPointer).with("oid", pointer.oid).with("size", pointer.size).into());
    }
    if file_len < 8 {
        return Err(fault(FaultKind::FileTooShort).with("file_len", file_len).into());
    }
    let short =
        || Box::new(fault(FaultKind::UnreadableFile).with("reason", "fewer bytes could be read than the file has"));
    let length = head.first_chunk::<8>().ok_or_else(short)?;
    let stated = u64::from_le_bytes(*length);
    let available = file_len.saturating_sub(8);
    if stated == 0 || stated > available || stated > MAX_HEADER {
        if let Some(what) = other_format(head) {
            return Err(fault(FaultKind::NotSafetensors).with("what", what).into());
        }
        if stated > MAX_HEADER && stated <= available {
            return Err(fault(FaultKind::HeaderTooLarge).with("stated", stated).with("cap", MAX_HEADER).into());
        }
        let big = u64::from_be_bytes(*length);
        let big_endian = big >= 2 && big <= available.min(MAX_HEADER);
        let fault = fault(FaultKind::HeaderLengthOutOfRange).with("stated", stated).with("file_len", file_len);
        return Err(fault.with("big_endian", big_endian).into());
    }
    let end = stated.saturating_add(8);
    let header = usize::try_from(end).ok().and_then(|end| head.get(8..end)).ok_or_else(short)?;
    Ok((header, end))
}

/// Describes a file whose length field is not plausible for a safetensors file.
pub(in crate::checkpoint) fn other_format(head: &[u8]) -> Option<String> {
    if let Some(what) = looks_like(head) {
        return Some(what.to_owned());
    }
    let sample = head.get(..head.len().min(512)).unwrap_or_default();
    if sample.iter().all(|b| *b == 0) {
        return Some("only NUL bytes".to_owned());
    }
    let text = sample.iter().all(|b| matches!(b, b' '..=b'~' | b'\t' | b'\n' | b'\r'));
    let start = || escape(&String::from_utf8_lossy(sample).trim().chars().take(60).collect::<String>(), 60);
    match sample.trim_ascii_start().first() {
        Some(b'{' | b'[') if text => Some(format!("a JSON document: {}", start())),
        Some(_) if text => Some(format!("a text file: {}", start())),
        _ => None,
    }
}

/// Maximum number of entries read of one header, counting tensors and metadata apart. The largest models have some
/// hundred thousand over all shards, and each entry takes more memory than its bytes.
const MAX_ENTRIES: usize = 200_000;

/// Maximum length of a tensor's name in bytes. Published ones have some 100; a name is part of every message about it.
const MAX_NAME: usize = 16 << 10;

/// Content of `__metadata__`.
enum HeaderMetadata {
    Absent,
    Null,
    Strings(BTreeMap<String, String>),
}

fn check_format(shard: &Shard, metadata: &HeaderMetadata, faults: &mut Faults) {
    let format = match metadata {
        HeaderMetadata::Strings(strings) => strings.get("format"),
        HeaderMetadata::Absent | HeaderMetadata::Null => None,
    };
    if format.is_none_or(|f| !FORMATS.contains(&f.as_str())) {
        let fault = Fault::new(FaultKind::NoFormatMetadata).at(shard.place());
        let given = matches!(metadata, HeaderMetadata::Strings(_));
        faults.push(fault.with("metadata", given).with("format", format.map(|f| escape(f, 80))));
    }
}

/// Keeps the last of duplicate names, as Python does, and reports the others.
fn without_duplicates(shard: &Shard, entries: Vec<HeaderEntry>, faults: &mut Faults) -> Vec<HeaderEntry> {
    let mut drop = vec![false; entries.len()];
    let mut last: HashMap<&str, usize> = HashMap::with_capacity(entries.len());
    for (at, entry) in entries.iter().enumerate() {
        if let Some(drop) = last.insert(&entry.name, at).and_then(|earlier| drop.get_mut(earlier)) {
            *drop = true;
        }
    }
    for entry in entries.iter().zip(&drop).filter_map(|(e, d)| d.then_some(e)) {
        let place = shard.place().in_tensor(entry.name.clone());
        faults.push(Fault::new(FaultKind::DuplicateHeaderKey).at(place).with("key", escape(&entry.name, 200)));
    }
    entries.into_iter().zip(drop).filter_map(|(e, d)| (!d).then_some(e)).collect()
}

struct HeaderReader<'s, 't, 'b> {
    shard: &'s Shard,
    scanner: Scanner<'t>,
    faults: Faults,
    entries: Vec<HeaderEntry>,
    metadata: HeaderMetadata,
    /// What is left for the entries of this header and of further shards.
    budget: &'b mut Budget,
}

/// Reason for abandoning a header with too many entries.
const TOO_MANY: &str = "too many entries";

/// Reason for abandoning a header that needs more than is left for the checkpoint. It is no fault of the shard: the reader
/// of the directory reports it.
const TOO_LARGE: &str = "the checkpoint is too large";

fn too_large() -> ScanError {
    ScanError { kind: ScanErrorKind::Syntax(TOO_LARGE), span: 0..0 }
}

fn too_many() -> ScanError {
    ScanError { kind: ScanErrorKind::Syntax(TOO_MANY), span: 0..0 }
}

/// The error for a header that ends early.
fn ended() -> ScanError {
    ScanError { kind: ScanErrorKind::Syntax("the header ends too early"), span: 0..0 }
}

impl<'t> HeaderReader<'_, 't, '_> {
    fn token(&mut self) -> Result<Token<'t>, ScanError> {
        Ok(self.scanner.next()?.ok_or_else(ended)?.0)
    }

    /// Reads the whole header.
    fn object(&mut self) -> Result<(), ScanError> {
        let first = self.token()?;
        if first != Token::BeginObject {
            return Err(ScanError { kind: ScanErrorKind::Syntax("the header is not an object"), span: 0..0 });
        }
        let mut metadata_seen = false;
        while let Token::Key(key) = self.token()? {
            if self.entries.len() >= MAX_ENTRIES {
                return Err(too_many());
            }
            let (name, lone) = key.decode();
            if name == "__metadata__" {
                if metadata_seen {
                    let fault = Fault::new(FaultKind::DuplicateHeaderKey).at(self.shard.place());
                    self.faults.push(fault.with("key", "__metadata__"));
                }
                metadata_seen = true;
                self.read_metadata()?;
            } else if name.len() > MAX_NAME {
                self.skip_entry(&name)?;
            } else {
                self.check_name(&name, lone);
                self.read_entry(name.into_owned())?;
            }
        }
        // The scanner reports text after the object, other than space, as an error.
        self.scanner.next().map(|_| ())
    }

    /// Skips an entry with a name above [`MAX_NAME`], which stands among the unreadable ones with the start of its name.
    fn skip_entry(&mut self, name: &str) -> Result<(), ScanError> {
        if !self.budget.spend_entry(0) {
            return Err(too_large());
        }
        let value = self.token()?;
        self.scanner.skip_rest_of(&value)?;
        let start = escape(name, 200);
        let fault = Fault::new(FaultKind::OddTensorName).at(self.shard.place().in_tensor(start.clone()));
        self.faults.push(fault.with("reason", "it is longer than 1 KiB").with("bytes", name.len()));
        self.entries.push(HeaderEntry { name: start, dtype: None, shape: None, offsets: None });
        Ok(())
    }

    fn read_metadata(&mut self) -> Result<(), ScanError> {
        let fault = Fault::new(FaultKind::MetadataNotStrings).at(self.shard.place());
        match self.token()? {
            Token::Null => {
                self.faults.push(Fault::new(FaultKind::MetadataNull).at(self.shard.place()));
                self.metadata = HeaderMetadata::Null;
            }
            Token::BeginObject => {
                let mut strings = BTreeMap::new();
                while let Token::Key(key) = self.token()? {
                    if strings.len() >= MAX_ENTRIES {
                        return Err(too_many());
                    }
                    let key = key.decode().0.into_owned();
                    if !self.budget.spend_entry(key.len()) {
                        return Err(too_large());
                    }
                    match self.token()? {
                        Token::String(value) if !value.decode().1 => {
                            if strings.contains_key(&key) {
                                let label = format!("__metadata__.{}", escape(&key, 80));
                                let fault = Fault::new(FaultKind::DuplicateHeaderKey).at(self.shard.place());
                                self.faults.push(fault.with("key", label));
                            }
                            let value = value.decode().0.into_owned();
                            if !self.budget.spend_entry(value.len()) {
                                return Err(too_large());
                            }
                            strings.insert(key, value);
                        }
                        other => {
                            self.scanner.skip_rest_of(&other)?;
                            let plain = match other {
                                Token::Number(literal) => Some(literal.to_owned()),
                                Token::Bool(value) => Some(value.to_string()),
                                _ => None,
                            };
                            let fault = fault.clone().with("key", escape(&key, 80)).with("scalar", plain.is_some());
                            self.faults.push(fault);
                            strings.extend(plain.map(|value| (key, value)));
                        }
                    }
                }
                self.metadata = HeaderMetadata::Strings(strings);
            }
            other => {
                self.scanner.skip_rest_of(&other)?;
                self.faults.push(fault);
            }
        }
        Ok(())
    }

    fn check_name(&mut self, name: &str, lone: bool) {
        let reason = if lone {
            "it has an unpaired surrogate escape"
        } else if name.is_empty() {
            "it is empty"
        } else if name.len() > 1024 {
            "it is longer than 1 KiB"
        } else if name.chars().any(char::is_control) {
            "it has control characters"
        } else if name.starts_with('/') || name.contains('\\') || name.split('/').any(|part| part == "..") {
            "it looks like a path"
        } else {
            return;
        };
        let place = self.shard.place().in_tensor(name);
        self.faults
            .push(Fault::new(FaultKind::OddTensorName).at(place).with("reason", reason).with("bytes", name.len()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tensors_of_a_header_that_is_not_read_are_counted() {
        for (header, expected) in [
            (r"{}", 0),
            (r#"{"a":{"shape":[1,[2]]},"b":{}}"#, 2),
            (r#"{"__metadata__":{"a":"{"},"b":{"dtype":"}"}}"#, 1),
            // Braces, quotes and backslashes inside of names.
            (r#"{"{":{"x":1},"b":{}}"#, 2),
            (r#"{"a\"{":{},"b\\":{},"c\\\"":{}}"#, 3),
            // A header that ends early.
            (r#"{"a":{"shape":[1]},"b":{"sh"#, 2),
            (r#"{"a":{},"b"#, 1),
        ] {
            assert_eq!(count(header.as_bytes()), expected, "{header}");
        }
    }
}
