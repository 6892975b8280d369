//! Renders a chat template in a sandbox.

use serde::{Deserialize, Serialize};

use minijinja::syntax::SyntaxConfig;
use minijinja::value::{Kwargs, Rest};
use minijinja::{Environment, Error, ErrorKind, State, Value, context, filters};
use minijinja_contrib::pycompat;
use regex::Regex;
use std::sync::LazyLock;

/// Longest template that is parsed, in bytes: the parser counts columns in 16 bits. Those of published models have at most
/// some 30 000.
pub(super) const MAX_TEXT: usize = 60_000;

/// Work that one rendering may do in this process: instructions, or 64 bytes of data each. Real templates take a few thousand.
pub(super) const FUEL: u64 = 60_000;

/// Work that one rendering may do in a process of its own.
pub(super) const MUCH_FUEL: u64 = 400_000;

/// Longest text of a conversation of two messages, in bytes.
const MAX_RENDERED: usize = 256 << 10;

/// Longest string that a method of Python is applied to: the engine charges for their results only when they exist.
const MAX_STRING: usize = 64 << 10;

/// Depth of calls and loops.
const MAX_DEPTH: usize = 60;

/// Spaces that `tojson` may indent by; the engine charges for its text when that exists.
const MAX_INDENT: u64 = 8;

/// Start of the detail of an error that stops a rendering because of what it would cost.
const COSTLY: &str = "costly: ";

/// The engine's words for what is nested deeper than [`MAX_DEPTH`], and part of its parser's for what is nested too deeply.
const TOO_DEEP: &str = "recursion limit exceeded";
const PARSED_TOO_DEEP: &str = "maximum recursion";

/// What the messages say, so that their places in the text are known.
const USER: &str = "qhGxUser1wVk";
const ASSISTANT: &str = "qhGxAssistant2wVk";

/// Reasons of the parser for templates that Jinja2 takes: statements that need a loader of templates, letters outside ASCII
/// in names, tuples without parentheses, signs without a number, empty subscripts; and its own limits. They are those of
/// mutated templates in `tests/peer/templates.py`.
const LIMITS: [&str; 11] = [
    "unknown statement include",
    "unknown statement import",
    "unknown statement from",
    "unknown statement extends",
    "unknown statement block",
    "unexpected character",
    "unexpected end of comment",
    "unexpected `,`, expected end of",
    "unexpected `+`",
    "unexpected `]`",
    "too many",
];

/// Tags of transformers' own extension, which mark the text of the assistant for training.
static GENERATION: LazyLock<Option<Regex>> =
    LazyLock::new(|| Regex::new(r"\{%([-+]?)\s*(end)?generation\s*([-+]?)%\}").ok());

/// What became of a template.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Rendering {
    /// It is not Jinja; the line, and the reason.
    Invalid {
        /// From 1.
        line: usize,
        /// The words of the parser.
        reason: String,
    },
    /// Text of a short conversation.
    Done(Rendered),
    /// It would cost too much, and why.
    Refused(String),
    /// It failed.
    Unknown,
}

/// A user's question and the assistant's answer as text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rendered {
    /// All of it.
    pub(super) text: String,
    /// What follows the answer.
    pub(super) after_assistant: String,
}

impl Rendering {
    /// Renders a template for one turn of each side, with these special tokens. Called with [`FUEL`] for a template of the allow
    /// list, and in a process under limits with [`MUCH_FUEL`] for any other.
    pub(super) fn of(text: &str, special: &[(String, String)], fuel: u64) -> Self {
        let plain = without_generation(text);
        let Some(environment) = environment(fuel) else { return Self::Unknown };
        let template = match environment.template_from_str(&plain) {
            Ok(template) => template,
            Err(error) => return Self::of_error(&error),
        };
        // Templates of vision-language models may take a list of parts.
        let parts = |text: &str| Value::from(vec![context! { type => "text", text => text }]);
        let words = |text: &str| Value::from(text);
        let contents: [&dyn Fn(&str) -> Value; 2] = [&words, &parts];
        let mut refused = None;
        for content in contents {
            match template.render(variables(content, special)) {
                Ok(text) if text.len() > MAX_RENDERED => {
                    refused = refused.or_else(|| Some(format!("it writes {} bytes for two messages", text.len())));
                }
                Ok(text) => {
                    if let Some((_, after)) = text.split_once(ASSISTANT).filter(|(before, _)| before.contains(USER)) {
                        return Self::Done(Rendered { after_assistant: after.to_owned(), text });
                    }
                }
                Err(error) => refused = refused.or_else(|| excess(&error, fuel)),
            }
        }
        refused.map_or(Self::Unknown, Self::Refused)
    }

    fn of_error(error: &Error) -> Self {
        let reason = error.detail().unwrap_or_default();
        if reason.contains(PARSED_TOO_DEEP) {
            return Self::Refused("it is nested more deeply than is parsed".to_owned());
        }
        if error.kind() != ErrorKind::SyntaxError || LIMITS.iter().any(|limit| reason.contains(limit)) {
            return Self::Unknown;
        }
        Self::Invalid { line: error.line().unwrap_or(1), reason: reason.to_owned() }
    }
}

/// What a rendering would have cost, if that is why it stopped.
fn excess(error: &Error, fuel: u64) -> Option<String> {
    let own = error.detail().and_then(|detail| detail.strip_prefix(COSTLY)).map(str::to_owned);
    let is_long = error.kind() == ErrorKind::OutOfFuel;
    let is_deep = error.detail() == Some(TOO_DEEP);
    let own = own.or_else(|| is_deep.then(|| format!("its calls and loops are nested more than {MAX_DEPTH} deep")));
    own.or_else(|| is_long.then(|| format!("a conversation of two messages takes more than {fuel} steps")))
}

/// The filter `tojson`, with indents that text has.
fn tojson(value: &Value, indent: Option<Value>, options: Kwargs) -> Result<Value, Error> {
    let asked = indent.clone().or_else(|| options.peek::<Value>("indent").ok());
    let spaces = asked.filter(Value::is_number).map(|asked| u64::try_from(asked).unwrap_or(u64::MAX));
    match spaces.filter(|spaces| *spaces > MAX_INDENT) {
        Some(spaces) => {
            let detail = format!("{COSTLY}tojson indents by {spaces} spaces, more than {MAX_INDENT}");
            Err(Error::new(ErrorKind::InvalidOperation, detail))
        }
        None => filters::tojson(value, indent, options),
    }
}

/// The variables that `apply_chat_template` passes.
fn variables(content: &dyn Fn(&str) -> Value, special: &[(String, String)]) -> Value {
    let message = |role: &str, text: &str| context! { role => role, content => content(text) };
    let messages = vec![message("user", USER), message("assistant", ASSISTANT)];
    let fixed = context! { messages => messages, add_generation_prompt => false };
    let tokens = Value::from_pairs(
        special.iter().map(|(name, token)| (Value::from(name.as_str()), Value::from(token.as_str()))),
    );
    context! { ..fixed, ..tokens }
}

/// The environment of transformers: blocks take their lines with them, and break and continue are known.
fn environment(fuel: u64) -> Option<Environment<'static>> {
    let mut environment = Environment::new();
    environment.set_syntax(SyntaxConfig::builder().trim_blocks(true).lstrip_blocks(true).build().ok()?);
    environment.set_fuel(Some(fuel));
    environment.set_recursion_limit(MAX_DEPTH);
    environment.set_auto_escape_callback(|_| minijinja::AutoEscape::None);
    environment.set_unknown_method_callback(method);
    environment.add_filter("tojson", tojson);
    environment.add_function("raise_exception", |_: Rest<Value>| -> Result<Value, Error> {
        Err(Error::new(ErrorKind::InvalidOperation, "raised by the template"))
    });
    environment.add_function("strftime_now", |_: Rest<Value>| "01 Jan 2026");
    Some(environment)
}

/// Methods of Python's strings and dicts. Those that multiply their input are filters of the engine, which bounds them.
fn method(state: &mut State<'_, '_>, value: &Value, name: &str, args: &[Value]) -> Result<Value, Error> {
    let is_long = |value: &Value| value.as_str().is_some_and(|text| text.len() > MAX_STRING);
    if is_long(value) || args.iter().any(is_long) {
        return Err(ErrorKind::OutOfFuel.into());
    }
    match (name, args) {
        ("replace", [from, to]) => state.apply_filter("replace", &[value.clone(), from.clone(), to.clone()]),
        ("join", [list]) => state.apply_filter("join", &[list.clone(), value.clone()]),
        ("replace" | "join" | "format", _) => Err(ErrorKind::UnknownMethod.into()),
        _ => pycompat::unknown_method_callback(state, value, name, args),
    }
}

/// The template with `generation` tags as conditions that hold.
fn without_generation(text: &str) -> String {
    let Some(tags) = GENERATION.as_ref() else { return text.to_owned() };
    let tag = |found: &regex::Captures<'_>| {
        let part = |i: usize| found.get(i).map_or("", |m| m.as_str());
        let word = if part(2).is_empty() { "if true" } else { "endif" };
        format!("{{%{} {word} {}%}}", part(1), part(3))
    };
    tags.replace_all(text, tag).into_owned()
}
