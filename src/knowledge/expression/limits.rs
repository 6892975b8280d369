//! Limits for the expressions and templates of a user's files: rules, architectures, recipes.
//!
//! Built-in files have none: they are known to end, and their values are small.

/// Maximum length of an expression in bytes, four times that of the longest built-in one.
pub(super) const SOURCE: usize = 4096;

/// Maximum number of operators and selections: each one may be nested in the one before it, and the parser, the evaluation
/// and the destructor recurse over them.
const OPERATORS: usize = 250;

/// Maximum nesting of brackets of any kind.
const NESTING: usize = 24;

/// Steps of one evaluation outside of a rule, whose evaluations share a limit of their own: elements that loops visit, and
/// eight-byte words of the values that they, `+` and function calls produce.
pub(super) const STEPS: u64 = 2_000_000;

/// Maximum size of the value of an expression, in nested values and eight-byte words of text.
pub(super) const VALUE: u64 = 250_000;

/// Maximum length of a rendered template in bytes.
pub(super) const TEXT: usize = 1 << 20;

/// Refuses a source text that is longer or more deeply nested than the limits, before it is parsed.
pub(super) fn check(source: &str) -> Result<(), String> {
    if source.len() > SOURCE {
        return Err(format!("it has {} bytes; at most {SOURCE} are allowed", source.len()));
    }
    let (mut open, mut deepest, mut operators) = (0_usize, 0_usize, 0_usize);
    let mut quote = None;
    let mut escaped = false;
    for byte in source.bytes() {
        match (quote, byte) {
            (Some(_), _) if escaped => escaped = false,
            (Some(_), b'\\') => escaped = true,
            (Some(q), _) if q == byte => quote = None,
            (None, b'"' | b'\'') => quote = Some(byte),
            (None, b'(' | b'[' | b'{') => {
                open = open.saturating_add(1);
                operators = operators.saturating_add(1);
            }
            (None, b')' | b']' | b'}') => open = open.saturating_sub(1),
            (None, b'+' | b'-' | b'*' | b'/' | b'%' | b'!' | b'?' | b'<' | b'>' | b'=' | b'&' | b'|' | b'.') => {
                operators = operators.saturating_add(1);
            }
            _ => {}
        }
        deepest = deepest.max(open);
    }
    if deepest > NESTING {
        return Err(format!("its brackets are nested {deepest} deep; at most {NESTING} are allowed"));
    }
    if operators > OPERATORS {
        return Err(format!("it has {operators} operators; at most {OPERATORS} are allowed"));
    }
    Ok(())
}
