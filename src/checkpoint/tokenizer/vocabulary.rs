//! A vocabulary in little memory: all tokens in one string, sorted.

use crate::checkpoint::files;
use std::borrow::Cow;

use super::super::Document;
use super::super::scan::{Scanner, Token};
use super::sentencepiece;

/// Maximum number of tokens read; the largest published vocabulary has 901 629 (XLM-V).
const MAX_TOKENS: usize = 1_500_000;
const TOO_MANY: &str = "it has more than a million and a half tokens";

/// Tokens and their ids. A 256 000-word vocabulary takes some 5 MB.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Vocabulary {
    arena: String,
    /// Start and end in `arena`, and the id; sorted by token, each token once.
    tokens: Vec<(u32, u32, u32)>,
    /// Number of distinct tokens.
    len: u64,
}

impl Vocabulary {
    /// Reads a vocabulary file that is not JSON: `vocab.txt` (one token per line) or a sentencepiece model.
    ///
    /// # Errors
    /// The reason, when the bytes are neither.
    pub fn parse(name: &str, bytes: &[u8]) -> Result<Self, &'static str> {
        if name == files::VOCAB_TXT {
            let text = std::str::from_utf8(bytes).map_err(|_| "it is not UTF-8")?;
            return Self::collect(text.lines().zip(0..));
        }
        Self::collect(sentencepiece::pieces(bytes)?.into_iter().zip(0..))
    }

    /// Reads the vocabulary at `pointer` of a document: an object of ids by token, or a list of pairs of token and
    /// score.
    ///
    /// # Errors
    /// The reason, when the vocabulary exceeds [`MAX_TOKENS`] or 4 GiB.
    pub(super) fn from_document(document: &Document, pointer: &str) -> Result<Option<Self>, &'static str> {
        let mut many = false;
        let entries = Self::entries(document, pointer, &mut many);
        if many { Err(TOO_MANY) } else { entries.map(Self::collect).transpose() }
    }

    /// Tokens and ids in text order; sets `many` when there are more than [`MAX_TOKENS`].
    fn entries<'d>(document: &'d Document, pointer: &str, many: &mut bool) -> Option<Vec<(Cow<'d, str>, u32)>> {
        let text = document.text.as_deref()?;
        // A document that could not be parsed has no value, and so no vocabulary.
        document.value.as_ref()?;
        let span = document.locate(pointer)?;
        let mut scanner = Scanner::lenient(text, span.start);
        let mut entries = Vec::new();
        let mut full = |entries: &Vec<_>| {
            *many = entries.len() >= MAX_TOKENS;
            *many
        };
        match scanner.next().ok()??.0 {
            Token::BeginObject => loop {
                match scanner.next().ok()??.0 {
                    Token::EndObject => break,
                    _ if full(&entries) => return None,
                    Token::Key(key) => {
                        let id = match scanner.next().ok()??.0 {
                            Token::Number(id) => id.parse().ok()?,
                            _ => return None,
                        };
                        entries.push((key.decode().0, id));
                    }
                    _ => return None,
                }
            },
            Token::BeginArray => loop {
                match scanner.next().ok()??.0 {
                    Token::EndArray => break,
                    _ if full(&entries) => return None,
                    Token::BeginArray => {
                        let Token::String(token) = scanner.next().ok()??.0 else { return None };
                        entries.push((token.decode().0, u32::try_from(entries.len()).ok()?));
                        let (Token::Number(_), Token::EndArray) = (scanner.next().ok()??.0, scanner.next().ok()??.0)
                        else {
                            return None;
                        };
                    }
                    _ => return None,
                }
            },
            _ => return None,
        }
        Some(entries)
    }

    fn collect(entries: impl IntoIterator<Item = (impl AsRef<str>, u32)>) -> Result<Self, &'static str> {
        const TOO_LARGE: &str = "it is larger than 4 GiB";
        let mut vocabulary = Self::default();
        for (token, id) in entries {
            if vocabulary.tokens.len() >= MAX_TOKENS {
                return Err(TOO_MANY);
            }
            let start = u32::try_from(vocabulary.arena.len()).map_err(|_| TOO_LARGE)?;
            vocabulary.arena.push_str(token.as_ref());
            let end = u32::try_from(vocabulary.arena.len()).map_err(|_| TOO_LARGE)?;
            vocabulary.tokens.push((start, end, id));
        }
        let Self { arena, tokens, .. } = &mut vocabulary;
        // The bytes of tokens have the order of their text, without a look at the bounds of characters.
        let bytes = arena.as_bytes();
        let text = |t: &(u32, u32, u32)| bytes.get(t.0 as usize..t.1 as usize).unwrap_or_default();
        tokens.sort_unstable_by(|a, b| text(a).cmp(text(b)).then(a.0.cmp(&b.0)));
        // Of duplicate tokens the last counts, as in a Python dict.
        tokens.reverse();
        tokens.dedup_by(|a, b| text(a) == text(b));
        tokens.reverse();
        vocabulary.len = u64::try_from(vocabulary.tokens.len()).unwrap_or(u64::MAX);
        Ok(vocabulary)
    }

    /// Number of distinct tokens.
    #[must_use]
    pub const fn len(&self) -> u64 {
        self.len
    }

    /// Whether the vocabulary has no tokens.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The id of a token.
    #[must_use]
    pub fn id_of(&self, wanted: &str) -> Option<u64> {
        let at = self.tokens.binary_search_by(|t| token(&self.arena, *t).cmp(wanted)).ok()?;
        self.tokens.get(at).map(|t| u64::from(t.2))
    }

    /// Highest id; `None` without tokens.
    #[must_use]
    pub fn max_id(&self) -> Option<u64> {
        self.tokens.iter().map(|t| u64::from(t.2)).max()
    }

    /// All tokens with their ids, sorted by token.
    pub fn iter(&self) -> impl Iterator<Item = (&str, u64)> {
        self.tokens.iter().map(|t| (token(&self.arena, *t), u64::from(t.2)))
    }
}

/// Whether the merges of this tokenizer.json are pairs of strings, and not strings with a blank: by the first of them.
#[must_use]
pub fn has_paired_merges(document: &Document) -> bool {
    let second = || {
        document.value.as_ref()?;
        let mut scanner = Scanner::lenient(document.text.as_deref()?, document.locate("/model/merges")?.start);
        scanner.next().ok()??;
        Some(scanner.next().ok()??.0)
    };
    matches!(second(), Some(Token::BeginArray))
}

fn token(arena: &str, (start, end, _): (u32, u32, u32)) -> &str {
    // u32 fits usize on every platform with more than 16 bits.
    arena.get(start as usize..end as usize).unwrap_or_default()
}
