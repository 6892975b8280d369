//! Finds duplicate keys of an object in little memory.

use std::hash::{BuildHasher as _, RandomState};
use std::ops::Range;

use super::build::{ValueBuilder, is_long_integer};
use crate::checkpoint::fault::KIND_CAP;
use crate::checkpoint::pointer;
use crate::checkpoint::scan::{Scanner, Token};

/// Two members of one object with the same key.
pub(super) struct Duplicate {
    pub(super) key: String,
    pub(super) pointer: Option<String>,
    pub(super) first: Range<usize>,
    pub(super) later: Range<usize>,
    /// Whether both have the same value.
    pub(super) equal: bool,
}

/// Values larger than this are compared as text only.
const COMPARE_CAP: usize = 1 << 20;

/// Maximum number of bytes read again in one document: duplicate keys around ever larger values would otherwise make
/// the read quadratic.
const REREAD_CAP: usize = 256 << 20;

/// Maximum number of duplicates compared in one document.
const FOUND_CAP: usize = 16 * KIND_CAP;

/// Keys of all open objects, each as a hash and the offset of the key. The hash is seeded, so collisions cannot be
/// crafted. A key takes 16 bytes; a map of a 256 000-word vocabulary would take as much memory as the text.
pub(super) struct Duplicates<'t> {
    text: &'t str,
    hasher: RandomState,
    keys: Vec<(u64, usize)>,
    /// Position in `keys` where each open object begins.
    frames: Vec<usize>,
    found: Vec<Duplicate>,
    /// Bytes that may still be read a second time, to compare the values of equal keys.
    budget: usize,
}

impl<'t> Duplicates<'t> {
    pub(super) fn new(text: &'t str) -> Self {
        Self {
            text,
            hasher: RandomState::new(),
            keys: Vec::new(),
            frames: Vec::new(),
            found: Vec::new(),
            budget: REREAD_CAP,
        }
    }

    /// Adds one token; call it before `builder` receives the token.
    pub(super) fn on_token(&mut self, token: &Token<'_>, span: &Range<usize>, builder: &ValueBuilder) {
        match token {
            Token::BeginObject => self.frames.push(self.keys.len()),
            Token::Key(key) => self.keys.push((self.hasher.hash_one(&*key.decode().0), span.start)),
            Token::EndObject => {
                let from = self.frames.pop().unwrap_or(0);
                self.close(from, builder);
                self.keys.truncate(from);
            }
            _ => {}
        }
    }

    fn close(&mut self, from: usize, builder: &ValueBuilder) {
        let Some(keys) = self.keys.get_mut(from..) else { return };
        if keys.len() < 2 {
            return;
        }
        keys.sort_unstable();
        for pair in keys.windows(2) {
            let [(a, first), (b, later)] = pair else { continue };
            if a != b || self.found.len() >= FOUND_CAP || self.budget == 0 {
                continue;
            }
            let (Some(first), Some(later)) = (member(self.text, *first), member(self.text, *later)) else { continue };
            self.budget = self.budget.saturating_sub(first.value.len()).saturating_sub(later.value.len());
            if first.name != later.name {
                continue;
            }
            let pointer = builder.container().map(|mut pointer| {
                pointer::push(&mut pointer, &later.name);
                pointer
            });
            let equal =
                same(self.text.get(first.value).unwrap_or_default(), self.text.get(later.value).unwrap_or_default());
            self.found.push(Duplicate { key: later.name, pointer, first: first.key, later: later.key, equal });
        }
    }

    /// The duplicates, in the order of the text.
    pub(super) fn into_found(mut self) -> Vec<Duplicate> {
        self.found.sort_by_key(|d| d.later.start);
        self.found
    }
}

struct KeyedMember {
    name: String,
    key: Range<usize>,
    value: Range<usize>,
}

/// Reads the member whose key starts at `at`.
fn member(text: &str, at: usize) -> Option<KeyedMember> {
    let mut scanner = Scanner::lenient(text, at);
    let (Token::String(name), key) = scanner.next().ok()?? else { return None };
    let rest = text.get(key.end..)?;
    let colon = rest.find(':')?;
    let mut scanner = Scanner::lenient(text, key.end.checked_add(colon)?.checked_add(1)?);
    let (first, value) = scanner.next().ok()??;
    scanner.skip_rest_of(&first).ok()?;
    Some(KeyedMember { name: name.decode().0.into_owned(), key, value: value.start..scanner.position() })
}

fn same(a: &str, b: &str) -> bool {
    if a == b {
        return true;
    }
    if a.len() > COMPARE_CAP || b.len() > COMPARE_CAP {
        return false;
    }
    let value = |text| {
        let mut scanner = Scanner::lenient(text, 0);
        let mut builder = ValueBuilder::new(Vec::new(), COMPARE_CAP);
        while let Ok(Some((token, span))) = scanner.next() {
            // Two such integers that differ may be the same double.
            if matches!(token, Token::Number(literal) if is_long_integer(literal)) {
                return None;
            }
            builder.on_token(&token, &span);
        }
        builder.finish().0
    };
    value(a).is_some_and(|a| value(b) == Some(a))
}
