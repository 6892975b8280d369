//! Makes strings from a checkpoint safe to print.

/// Control and invisible characters as escapes; what is beyond `cap` characters as `…`.
pub fn escape(text: &str, cap: usize) -> String {
    let mut out = String::new();
    for (n, c) in text.chars().enumerate() {
        if n >= cap { out.push('…'); break; }
        match c {
            '\n' => out.push_str("\\n"),
            '\t' => out.push_str("\\t"),
            '\r' => out.push_str("\\r"),
            c if c.is_control() || matches!(c, '\u{200b}'..='\u{200f}' | '\u{061c}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{e0000}'..='\u{e007f}') => out.extend(c.escape_unicode()),
            c => out.push(c),
        }
    }
    out
}
