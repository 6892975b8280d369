//! A JSON scanner: tokens with byte ranges, one at a time, never recursing.
//!
//! Documents, shard headers and [`Locator`](super::document::Locator) use the same scanner. It is iterative and limits
//! the depth, so nesting cannot exhaust the stack. The lenient mode accepts a few common slips of hand-written JSON and
//! records them, so that a fault can name the cause of a syntax error. `serde_json` is not used: it silently keeps the
//! last of two duplicate keys, has no byte ranges, and rounds integers of more than 64 bits.

use std::ops::Range;

mod atoms;
mod text;

pub(crate) use text::JsonString;

/// Deepest nesting read; the same as `serde_json` with its limit of 128.
pub(crate) const MAX_DEPTH: usize = 127;

/// One JSON token. As in Python's `json`, three non-finite literals are accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Token<'a> {
    BeginObject,
    EndObject,
    BeginArray,
    EndArray,
    Key(JsonString<'a>),
    String(JsonString<'a>),
    /// A number as written.
    Number(&'a str),
    /// `NaN`, `Infinity` or `-Infinity`.
    NonFinite(&'a str),
    Bool(bool),
    Null,
}

/// Reason for refusing a number that no double can represent.
const HUGE: &str = "a number larger than any double";

/// Maximum number of slips recorded for one text.
const SLIP_CAP: usize = 100_000;

/// A slip that a lenient scan accepts.
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

/// The error that ended a scan early.
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
    /// Text follows the value.
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
    /// Containers whose ends are known.
    known: &'a [Range<usize>],
    /// End of the last token, the place of a missing comma.
    last_end: usize,
    /// The last comma, which is a trailing one if a bracket follows.
    comma: Option<Range<usize>>,
    /// Slips accepted so far, the first [`SLIP_CAP`] of them; empty in a strict scan.
    pub(crate) slips: Vec<Slip>,
    /// The first token of a strict scan that this scanner accepts, so that a fault can name it, and strict JSON does
    /// not.
    pub(crate) refused: Option<ScanError>,
}

type ScanStep<'a> = Result<Option<(Token<'a>, Range<usize>)>, ScanError>;

impl<'a> Scanner<'a> {
    /// A strict scanner from byte `start` on (a character boundary; past the end means empty).
    pub(crate) fn strict(text: &'a str, start: usize) -> Self {
        Self {
            text,
            pos: start.min(text.len()),
            stack: Vec::new(),
            expect: Expect::Value,
            lenient: false,
            known: &[],
            last_end: start,
            comma: None,
            slips: Vec::new(),
            refused: None,
        }
    }

    /// A scanner that accepts and records trailing and missing commas, comments and single quotes.
    pub(crate) fn lenient(text: &'a str, start: usize) -> Self {
        Self { lenient: true, ..Self::strict(text, start) }
    }

    /// This scanner, which jumps to the end of these containers when it skips them.
    pub(crate) fn knowing(self, known: &'a [Range<usize>]) -> Self {
        Self { known, ..self }
    }

    /// Number of open containers.
    pub(crate) fn depth(&self) -> usize {
        self.stack.len()
    }

    /// Offset at which the search for the next token begins.
    pub(crate) const fn position(&self) -> usize {
        self.pos
    }

    /// The next token and its bytes; `None` after the value and trailing space.
    pub(crate) fn next(&mut self) -> ScanStep<'a> {
        loop {
            self.skip_space()?;
            let at = self.pos;
            let Some(byte) = self.peek() else {
                return if self.expect == Expect::Done {
                    Ok(None)
                } else {
                    Err(self.syntax(at, at, self.ends_inside()))
                };
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
                            self.slip(SlipKind::MissingComma, self.last_end..self.last_end);
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
                    let key = Token::Key(self.string(byte)?);
                    self.refuse(&key, at);
                    self.expect = Expect::Colon;
                    return Ok(Some((key, at..self.pos)));
                }
                Expect::Value | Expect::ElementOrEnd => return self.value(byte, at).map(Some),
            }
        }
    }

    /// Skips the rest of the value whose first token was just read, without building it.
    pub(crate) fn skip_rest_of(&mut self, first: &Token<'a>) -> Result<(), ScanError> {
        if !matches!(first, Token::BeginObject | Token::BeginArray) {
            return Ok(());
        }
        let depth = self.depth();
        self.jump();
        while self.depth() >= depth {
            match self.next()? {
                Some((Token::BeginObject | Token::BeginArray, _)) => self.jump(),
                Some(_) => {}
                None => break,
            }
        }
        Ok(())
    }

    /// Moves past the container whose bracket was just read, if its end is known.
    fn jump(&mut self) {
        let known = self.known.iter().find(|known| known.start.saturating_add(1) == self.pos);
        if let Some(known) = known {
            self.pos = known.end;
            self.stack.pop();
            self.after_value();
        }
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
        self.slip(SlipKind::Comment, at..self.pos);
        Ok(())
    }

    fn close(&mut self, object: bool, at: usize) -> (Token<'a>, Range<usize>) {
        self.stack.pop();
        self.pos = at.saturating_add(1);
        self.after_value();
        (if object { Token::EndObject } else { Token::EndArray }, at..self.pos)
    }

    fn close_after_comma(&mut self, object: bool, at: usize) -> ScanStep<'a> {
        match self.comma.take() {
            Some(span) if self.lenient => {
                self.slip(SlipKind::TrailingComma, span);
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
        self.refuse(&token, at);
        self.after_value();
        Ok((token, at..self.pos))
    }

    /// Records tokens that Rust's JSON readers refuse and Python's accept.
    fn refuse(&mut self, token: &Token<'a>, at: usize) {
        if self.lenient || self.refused.is_some() {
            return;
        }
        let reason = match token {
            Token::NonFinite(_) => "a number that is not finite",
            Token::Number(literal) if !literal.parse::<f64>().is_ok_and(f64::is_finite) => HUGE,
            Token::Key(text) | Token::String(text) if text.decode().1 => "an unpaired surrogate escape",
            _ => return,
        };
        self.refused = Some(self.syntax(at, self.pos, reason));
    }

    fn slip(&mut self, kind: SlipKind, span: Range<usize>) {
        if self.slips.len() < SLIP_CAP {
            self.slips.push(Slip { kind, span });
        }
    }

    fn ends_inside(&self) -> &'static str {
        match self.stack.last() {
            Some(true) => "the text ends inside an object",
            Some(false) => "the text ends inside an array",
            None => "the text contains no value",
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
