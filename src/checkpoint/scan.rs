//! A JSON scanner: tokens with byte ranges, one at a time, never recursing.
//!
//! One scanner serves documents, shard headers and the search for a place in a document. It is
//! iterative and bounded in depth, so no nesting can exhaust the stack, and it knows the few slips
//! people make by hand, so the slip that makes a document readable *is* the cause.
//! `serde_json` could not serve: it keeps the last of two equal keys without a word, has no byte
//! ranges, and (with `arbitrary_precision`) turns a crafted object into a number.

use std::borrow::Cow;
use std::ops::Range;

/// Deepest nesting read; what `serde_json` reads with its limit of 128.
pub(crate) const MAX_DEPTH: usize = 127;

/// A string as it stands in the text, without its quotes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Text<'a> {
    raw: &'a str,
    escaped: bool,
}

impl<'a> Text<'a> {
    /// The string after unescaping, and whether it held a lone surrogate (replaced by U+FFFD).
    pub(crate) fn decode(self) -> (Cow<'a, str>, bool) {
        if self.escaped { unescape(self.raw) } else { (Cow::Borrowed(self.raw), false) }
    }
}

/// One token of JSON as Python's `json` reads it: strict JSON and the three non-finite literals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Token<'a> {
    BeginObject,
    EndObject,
    BeginArray,
    EndArray,
    Key(Text<'a>),
    String(Text<'a>),
    /// A number as written.
    Number(&'a str),
    /// `NaN`, `Infinity` or `-Infinity`.
    NonFinite(&'a str),
    Bool(bool),
    Null,
}

/// A slip that a lenient scan reads past.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Slip {
    pub(crate) kind: SlipKind,
    pub(crate) span: Range<usize>,
}

/// Kinds of slip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SlipKind {
    TrailingComma,
    MissingComma,
    Comment,
    SingleQuotes,
}

/// Why a scan ended early.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ScanError {
    pub(crate) kind: ScanErrorKind,
    pub(crate) span: Range<usize>,
}

/// Kinds of early end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ScanErrorKind {
    /// Not JSON, for this reason.
    Syntax(&'static str),
    /// Nested deeper than [`MAX_DEPTH`].
    TooDeep,
    /// Something follows the one value.
    Trailing,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Expect {
    Value,
    /// After `[`: an element or the end.
    ElementOrEnd,
    /// After `{`: a key or the end.
    KeyOrEnd,
    /// After a comma in an object.
    Key,
    Colon,
    /// After a value inside an object or array.
    CommaOrEnd,
    Done,
}

/// The scanner. Each call of [`Scanner::next`] moves over one token.
#[derive(Debug)]
pub(crate) struct Scanner<'a> {
    text: &'a str,
    pos: usize,
    /// Open containers, outermost first; `true` for an object.
    stack: Vec<bool>,
    expect: Expect,
    lenient: bool,
    /// End of the last token, where a missing comma belongs.
    last_end: usize,
    /// The comma just read, for a trailing one.
    comma: Option<Range<usize>>,
    /// Slips read past so far; a strict scan makes none.
    pub(crate) slips: Vec<Slip>,
}

type Step<'a> = Result<Option<(Token<'a>, Range<usize>)>, ScanError>;

impl<'a> Scanner<'a> {
    /// Scans strictly, from byte `start` (a character boundary; past the end means empty).
    pub(crate) fn strict(text: &'a str, start: usize) -> Self {
        Self {
            text,
            pos: start.min(text.len()),
            stack: Vec::new(),
            expect: Expect::Value,
            lenient: false,
            last_end: start,
            comma: None,
            slips: Vec::new(),
        }
    }

    /// Scans past trailing and missing commas, comments and single quotes, and notes each.
    pub(crate) fn lenient(text: &'a str, start: usize) -> Self {
        Self { lenient: true, ..Self::strict(text, start) }
    }

    /// How many containers are open.
    pub(crate) fn depth(&self) -> usize {
        self.stack.len()
    }

    /// Where the next token is looked for.
    pub(crate) const fn position(&self) -> usize {
        self.pos
    }

    /// The next token and its bytes; `None` after the one value and nothing else but space.
    pub(crate) fn next(&mut self) -> Step<'a> {
        loop {
            self.skip_space()?;
            let at = self.pos;
            let Some(byte) = self.peek() else {
                return if self.expect == Expect::Done { Ok(None) } else { Err(self.syntax(at, at, self.ends_inside())) };
            };
            match self.expect {
                Expect::Done => {
                    return Err(ScanError { kind: ScanErrorKind::Trailing, span: at..self.text.len() });
                }
                Expect::Colon => {
                    if byte != b':' {
                        return Err(self.unexpected("expected `:` after a key"));
                    }
                    self.pos = at.saturating_add(1);
                    self.expect = Expect::Value;
                }
                Expect::CommaOrEnd => {
                    let object = self.stack.last().copied().unwrap_or(false);
                    match (byte, object) {
                        (b',', _) => {
                            self.pos = at.saturating_add(1);
                            self.comma = Some(at..self.pos);
                            self.expect = if object { Expect::Key } else { Expect::Value };
                        }
                        (b'}', true) | (b']', false) => return Ok(Some(self.close(object, at))),
                        _ if self.lenient && starts(byte, object) => {
                            self.slips.push(Slip { kind: SlipKind::MissingComma, span: self.last_end..self.last_end });
                            self.comma = None;
                            self.expect = if object { Expect::Key } else { Expect::Value };
                        }
                        _ if object => return Err(self.unexpected("expected `,` or `}`")),
                        _ => return Err(self.unexpected("expected `,` or `]`")),
                    }
                }
                Expect::KeyOrEnd if byte == b'}' => return Ok(Some(self.close(true, at))),
                Expect::ElementOrEnd if byte == b']' => return Ok(Some(self.close(false, at))),
                Expect::Key if byte == b'}' => return self.close_after_comma(true, at),
                Expect::Value if byte == b']' && self.stack.last() == Some(&false) => {
                    return self.close_after_comma(false, at);
                }
                Expect::KeyOrEnd | Expect::Key => {
                    if byte != b'"' && !(byte == b'\'' && self.lenient) {
                        return Err(self.unexpected("expected a key in double quotes"));
                    }
                    let key = self.string(byte)?;
                    self.expect = Expect::Colon;
                    return Ok(Some((Token::Key(key), at..self.pos)));
                }
                Expect::Value | Expect::ElementOrEnd => return self.value(byte, at).map(Some),
            }
        }
    }

    /// Moves over the rest of the value whose first token was just read, however large.
    pub(crate) fn skip_rest_of(&mut self, first: &Token<'a>) -> Result<(), ScanError> {
        if !matches!(first, Token::BeginObject | Token::BeginArray) {
            return Ok(());
        }
        let depth = self.depth();
        while self.depth() >= depth {
            if self.next()?.is_none() {
                break;
            }
        }
        Ok(())
    }

    fn peek(&self) -> Option<u8> {
        self.text.as_bytes().get(self.pos).copied()
    }

    fn byte(&self, at: usize) -> Option<u8> {
        self.text.as_bytes().get(at).copied()
    }

    fn skip_space(&mut self) -> Result<(), ScanError> {
        loop {
            match self.peek() {
                Some(b' ' | b'\t' | b'\n' | b'\r') => self.pos = self.pos.saturating_add(1),
                Some(b'/') if self.lenient => self.comment()?,
                _ => return Ok(()),
            }
        }
    }

    fn comment(&mut self) -> Result<(), ScanError> {
        let at = self.pos;
        let rest = self.text.get(at..).unwrap_or_default();
        let len = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if let Some(body) = rest.strip_prefix("/*") {
            let Some(end) = body.find("*/") else {
                return Err(self.syntax(at, self.text.len(), "a comment that is never closed"));
            };
            end.saturating_add(4)
        } else {
            return Err(self.unexpected("unexpected `/`"));
        };
        self.pos = at.saturating_add(len);
        self.slips.push(Slip { kind: SlipKind::Comment, span: at..self.pos });
        Ok(())
    }

    fn close(&mut self, object: bool, at: usize) -> (Token<'a>, Range<usize>) {
        self.stack.pop();
        self.pos = at.saturating_add(1);
        self.after_value();
        (if object { Token::EndObject } else { Token::EndArray }, at..self.pos)
    }

    fn close_after_comma(&mut self, object: bool, at: usize) -> Step<'a> {
        match self.comma.take() {
            Some(span) if self.lenient => {
                self.slips.push(Slip { kind: SlipKind::TrailingComma, span });
                Ok(Some(self.close(object, at)))
            }
            _ => Err(self.unexpected("a comma before the closing bracket")),
        }
    }

    fn after_value(&mut self) {
        self.last_end = self.pos;
        self.expect = if self.stack.is_empty() { Expect::Done } else { Expect::CommaOrEnd };
    }

    fn value(&mut self, byte: u8, at: usize) -> Result<(Token<'a>, Range<usize>), ScanError> {
        let token = match byte {
            b'{' | b'[' => {
                if self.stack.len() >= MAX_DEPTH {
                    return Err(ScanError { kind: ScanErrorKind::TooDeep, span: at..at.saturating_add(1) });
                }
                let object = byte == b'{';
                self.stack.push(object);
                self.pos = at.saturating_add(1);
                self.expect = if object { Expect::KeyOrEnd } else { Expect::ElementOrEnd };
                return Ok((if object { Token::BeginObject } else { Token::BeginArray }, at..self.pos));
            }
            b'"' => Token::String(self.string(b'"')?),
            b'\'' if self.lenient => Token::String(self.string(b'\'')?),
            b'-' | b'0'..=b'9' => self.number(at)?,
            _ => self.word(at)?,
        };
        self.after_value();
        Ok((token, at..self.pos))
    }

    fn word(&mut self, at: usize) -> Result<Token<'a>, ScanError> {
        const WORDS: [(&str, Token<'static>); 5] = [
            ("true", Token::Bool(true)),
            ("false", Token::Bool(false)),
            ("null", Token::Null),
            ("NaN", Token::NonFinite("NaN")),
            ("Infinity", Token::NonFinite("Infinity")),
        ];
        let rest = self.text.get(at..).unwrap_or_default();
        for (word, token) in WORDS {
            if rest.starts_with(word) {
                self.pos = at.saturating_add(word.len());
                return Ok(token);
            }
        }
        let reason = match rest.chars().next() {
            Some('T' | 'F' | 'N') if ["True", "False", "None"].iter().any(|w| rest.starts_with(w)) => {
                "a Python literal instead of `true`, `false` or `null`"
            }
            Some('+') => "a number with a leading `+`",
            Some('.') => "a number without a digit before the point",
            Some('\'') => "a string in single quotes",
            Some(',' | '}' | ']') => "a value is missing",
            Some(c) if c.is_alphanumeric() => "a word without quotes",
            _ => "unexpected character",
        };
        Err(self.unexpected(reason))
    }

    fn digits(&mut self) -> usize {
        let start = self.pos;
        while matches!(self.peek(), Some(b'0'..=b'9')) {
            self.pos = self.pos.saturating_add(1);
        }
        self.pos.saturating_sub(start)
    }

    fn number(&mut self, at: usize) -> Result<Token<'a>, ScanError> {
        if self.peek() == Some(b'-') {
            self.pos = self.pos.saturating_add(1);
            let rest = self.text.get(self.pos..).unwrap_or_default();
            if rest.starts_with("Infinity") {
                self.pos = self.pos.saturating_add("Infinity".len());
                return Ok(Token::NonFinite("-Infinity"));
            }
        }
        let first = self.peek();
        let whole = self.digits();
        if whole == 0 {
            return Err(self.syntax(at, self.pos, "a minus sign without a number"));
        }
        if first == Some(b'0') && whole > 1 {
            return Err(self.syntax(at, self.pos, "a number with a leading zero"));
        }
        if self.peek() == Some(b'.') {
            self.pos = self.pos.saturating_add(1);
            if self.digits() == 0 {
                return Err(self.syntax(at, self.pos, "a number without a digit after the point"));
            }
        }
        if matches!(self.peek(), Some(b'e' | b'E')) {
            self.pos = self.pos.saturating_add(1);
            if matches!(self.peek(), Some(b'+' | b'-')) {
                self.pos = self.pos.saturating_add(1);
            }
            if self.digits() == 0 {
                return Err(self.syntax(at, self.pos, "a number without a digit in its exponent"));
            }
        }
        Ok(Token::Number(self.text.get(at..self.pos).unwrap_or_default()))
    }

    /// Reads a string whose opening `quote` is at the position.
    fn string(&mut self, quote: u8) -> Result<Text<'a>, ScanError> {
        let open = self.pos;
        let start = open.saturating_add(1);
        let mut at = start;
        let mut escaped = false;
        loop {
            match self.byte(at) {
                Some(b) if b == quote => break,
                Some(b'\\') => {
                    escaped = true;
                    at = at.saturating_add(self.escape_len(at, quote)?);
                }
                Some(0..=0x1f) => {
                    return Err(self.syntax(at, at.saturating_add(1), "a control character inside a string"));
                }
                Some(_) => at = at.saturating_add(1),
                None => return Err(self.syntax(open, self.text.len(), "a string that is never closed")),
            }
        }
        self.pos = at.saturating_add(1);
        self.last_end = self.pos;
        if quote == b'\'' {
            self.slips.push(Slip { kind: SlipKind::SingleQuotes, span: open..self.pos });
        }
        Ok(Text { raw: self.text.get(start..at).unwrap_or_default(), escaped })
    }

    /// Bytes of the escape at `at`, checked.
    fn escape_len(&self, at: usize, quote: u8) -> Result<usize, ScanError> {
        let after = at.saturating_add(1);
        match self.byte(after) {
            Some(b'"' | b'\\' | b'/' | b'b' | b'f' | b'n' | b'r' | b't') => Ok(2),
            Some(b'\'') if quote == b'\'' => Ok(2),
            Some(b'u') => {
                let hex = self.text.as_bytes().get(at.saturating_add(2)..at.saturating_add(6)).unwrap_or_default();
                if hex.len() == 4 && hex.iter().all(u8::is_ascii_hexdigit) {
                    Ok(6)
                } else {
                    Err(self.syntax(at, after.saturating_add(1), "`\\u` without four hexadecimal digits"))
                }
            }
            Some(b) if b.is_ascii() => Err(self.syntax(at, after.saturating_add(1), "an escape that JSON does not have")),
            _ => Err(self.syntax(at, after, "an escape that JSON does not have")),
        }
    }

    fn ends_inside(&self) -> &'static str {
        match self.stack.last() {
            Some(true) => "the text ends inside an object",
            Some(false) => "the text ends inside an array",
            None => "the text holds no value",
        }
    }

    fn unexpected(&self, reason: &'static str) -> ScanError {
        let len = self.text.get(self.pos..).and_then(|t| t.chars().next()).map_or(0, char::len_utf8);
        self.syntax(self.pos, self.pos.saturating_add(len), reason)
    }

    #[allow(clippy::unused_self, reason = "reads like the other error makers")]
    const fn syntax(&self, start: usize, end: usize, reason: &'static str) -> ScanError {
        ScanError { kind: ScanErrorKind::Syntax(reason), span: start..end }
    }
}

/// Whether `byte` can begin a member of an object or an element of an array.
const fn starts(byte: u8, object: bool) -> bool {
    match byte {
        b'"' | b'\'' => true,
        b'{' | b'[' | b'-' | b'0'..=b'9' | b't' | b'f' | b'n' | b'N' | b'I' => !object,
        _ => false,
    }
}

/// Resolves escapes that [`Scanner::escape_len`] has accepted.
fn unescape(raw: &str) -> (Cow<'_, str>, bool) {
    let mut out = String::with_capacity(raw.len());
    let mut lone = false;
    let mut rest = raw;
    while let Some(at) = rest.find('\\') {
        out.push_str(rest.get(..at).unwrap_or_default());
        let escape = rest.get(at.saturating_add(1)..).unwrap_or_default();
        let mut used = 1;
        match escape.as_bytes().first() {
            Some(b'n') => out.push('\n'),
            Some(b't') => out.push('\t'),
            Some(b'r') => out.push('\r'),
            Some(b'b') => out.push('\u{8}'),
            Some(b'f') => out.push('\u{c}'),
            Some(b'u') => {
                let high = hex4(escape, 1);
                let low = if escape.get(5..7) == Some("\\u") { hex4(escape, 7) } else { None };
                used = 5;
                match (high, low) {
                    (Some(h @ 0xd800..=0xdbff), Some(l @ 0xdc00..=0xdfff)) => {
                        used = 11;
                        let scalar = 0x1_0000 + ((h - 0xd800) << 10) + (l - 0xdc00);
                        out.push(char::from_u32(scalar).unwrap_or(char::REPLACEMENT_CHARACTER));
                    }
                    (Some(h), _) => match char::from_u32(h) {
                        Some(c) => out.push(c),
                        None => {
                            lone = true;
                            out.push(char::REPLACEMENT_CHARACTER);
                        }
                    },
                    (None, _) => out.push(char::REPLACEMENT_CHARACTER),
                }
            }
            Some(b) => out.push(char::from(*b)),
            None => used = 0,
        }
        rest = escape.get(used..).unwrap_or_default();
    }
    out.push_str(rest);
    (Cow::Owned(out), lone)
}

fn hex4(text: &str, at: usize) -> Option<u32> {
    u32::from_str_radix(text.get(at..at.checked_add(4)?)?, 16).ok()
}
