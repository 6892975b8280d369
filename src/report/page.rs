//! Pages: one HTML file for a browser, without anything from elsewhere.
//!
//! A page is complete without its script, which filters and zooms. Its Content-Security-Policy lets nothing else run or load,
//! whatever a name in a checkpoint would say.

mod check;
mod differences;
mod finding;
mod inspection;
mod map;
mod merge;

use std::fmt::Write as _;

pub use self::check::render;
pub use self::differences::render as differences;
pub use self::inspection::render as inspection;
use super::format::{name, sentence};
use super::model::ToolInfo;
use crate::check::verdict::LoadVerdict;

const STYLE: &str = include_str!("page/page.css");
const SCRIPT: &str = include_str!("page/page.js");
/// What the policy of a page knows its script by: the SHA-256 of `page.js` in base64.
const SCRIPT_DIGEST: &str = "3s0XSWEe+QL1+qJ02e1+REZpKTkItS7Y7PvcwynWE4E=";

/// A page with this title; `body` is HTML.
fn page(title: &str, subtitle: &str, body: &str) -> String {
    let tool = ToolInfo::this();
    let (title, subtitle) = (text(title), text(subtitle));
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; \
         script-src 'sha256-{SCRIPT_DIGEST}'; base-uri 'none'; form-action 'none'\">\n\
         <title>{title} · {}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<header><h1>{title}</h1><p>{subtitle}</p></header>\n\
         <main>\n{body}</main>\n<footer>{} {}</footer>\n<script>\n{SCRIPT}</script>\n</body>\n</html>\n",
        tool.name, tool.name, tool.version
    )
}

/// Text in HTML.
fn text(plain: &str) -> String {
    let mut out = String::with_capacity(plain.len());
    for c in plain.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

/// A sentence that may quote a checkpoint.
fn words(plain: &str) -> String {
    text(&sentence(plain))
}

/// A name from a checkpoint, as code. It may break behind its dots and slashes.
fn code(raw: &str) -> String {
    let shown = text(&name(raw)).replace('.', ".<wbr>").replace('/', "/<wbr>");
    format!("<code>{shown}</code>")
}

/// A verdict in its colour.
fn verdict(verdict: LoadVerdict) -> String {
    let class = match verdict {
        LoadVerdict::Loads => "good",
        LoadVerdict::LoadsWrong | LoadVerdict::Raises => "bad",
        LoadVerdict::NotPredicted => "unknown",
    };
    format!("<span class=\"badge {class}\">{}</span>", verdict.name())
}

/// How the cells of a column stand.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Column {
    Left,
    Right,
}

/// A table; titles are text, cells are HTML. The first cell of a row is its heading.
fn table(out: &mut String, caption: &str, columns: &[(&str, Column)], rows: &[Vec<String>]) {
    if rows.is_empty() {
        return;
    }
    let _ok =
        write!(out, "<div class=\"wide\" tabindex=\"0\"><table><caption>{}</caption>\n<thead><tr>", text(caption));
    for (title, column) in columns {
        let _ok = write!(out, "<th scope=\"col\"{}>{}</th>", side(*column), text(title));
    }
    out.push_str("</tr></thead>\n<tbody>\n");
    for row in rows {
        out.push_str("<tr>");
        for (at, (cell, (_, column))) in row.iter().zip(columns).enumerate() {
            let _ok = match at {
                0 => write!(out, "<th scope=\"row\"{}>{cell}</th>", side(*column)),
                _ => write!(out, "<td{}>{cell}</td>", side(*column)),
            };
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody></table></div>\n");
}

const fn side(column: Column) -> &'static str {
    match column {
        Column::Left => "",
        Column::Right => " class=\"n\"",
    }
}

/// A list of sentences below a heading of the page; nothing without any. Items are HTML.
fn titled(out: &mut String, title: &str, items: &[String]) {
    if !items.is_empty() {
        let _ok = writeln!(out, "<h2>{}</h2>", text(title));
        list(out, items);
    }
}

/// A list of sentences; nothing without any. Items are HTML.
fn list(out: &mut String, items: &[String]) {
    if items.is_empty() {
        return;
    }
    let _ok = writeln!(out, "<ul>\n<li>{}</li>\n</ul>", items.join("</li>\n<li>"));
}

/// Lines of a program or of a document.
fn block(out: &mut String, lines: &[String]) {
    let shown: Vec<String> = lines.iter().map(|line| text(&line.replace(super::format::hostile, "\u{fffd}"))).collect();
    let _ok = writeln!(out, "<pre tabindex=\"0\">{}</pre>", shown.join("\n"));
}

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects, clippy::indexing_slicing, reason = "a test")]
mod tests {
    use sha2::{Digest as _, Sha256};

    use super::{SCRIPT, SCRIPT_DIGEST, code, page, text};

    fn base64(bytes: &[u8]) -> String {
        const LETTERS: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        let group = |three: &[u8]| {
            let bits = (0..3).fold(0_usize, |bits, at| bits << 8 | usize::from(three.get(at).copied().unwrap_or(0)));
            let letter =
                |at: usize| if at <= three.len() { char::from(LETTERS[bits >> (18 - 6 * at) & 63]) } else { '=' };
            (0..4).map(letter).collect::<String>()
        };
        bytes.chunks(3).map(group).collect()
    }

    /// The text between the tags is what a browser takes the digest of.
    #[test]
    fn the_policy_knows_the_script() {
        assert_eq!(base64(b"Ma"), "TWE=");
        assert_eq!(SCRIPT_DIGEST, base64(&Sha256::digest(format!("\n{SCRIPT}"))));
        assert!(page("a", "b", "").contains(&format!("<script>\n{SCRIPT}</script>")));
    }

    #[test]
    fn names_are_text_and_not_markup() {
        assert_eq!(text("<b a='\"'>&"), "&lt;b a=&#39;&quot;&#39;&gt;&amp;");
        assert_eq!(code("<a>.b/c"), "<code>&lt;a&gt;.<wbr>b/<wbr>c</code>");
        assert!(!page("</title><script>", "<i>", "").contains("<i>"));
    }
}
