//! Scans words, numbers and strings.

use super::{JsonString, ScanError, Scanner, SlipKind, Token};

impl<'a> Scanner<'a> {
    pub(super) fn word(&mut self, at: usize) -> Result<Token<'a>, ScanError> {
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

    pub(super) fn number(&mut self, at: usize) -> Result<Token<'a>, ScanError> {
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
    pub(super) fn string(&mut self, quote: u8) -> Result<JsonString<'a>, ScanError> {
        let open = self.pos;
        let start = open.saturating_add(1);
        let mut at = start;
        let mut escaped = false;
        loop {
            let rest = self.text.as_bytes().get(at..).unwrap_or_default();
            at = at.saturating_add(
                rest.iter().position(|b| *b == quote || *b == b'\\' || *b < 0x20).unwrap_or(rest.len()),
            );
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
            self.slip(SlipKind::SingleQuotes, open..self.pos);
        }
        Ok(JsonString { raw: self.text.get(start..at).unwrap_or_default(), escaped })
    }

    /// Length of the escape at `at`; fails when it is invalid.
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
            Some(b) if b.is_ascii() => {
                Err(self.syntax(at, after.saturating_add(1), "an escape that JSON does not have"))
            }
            _ => Err(self.syntax(at, after, "an escape that JSON does not have")),
        }
    }
}
