//! Finds templates that nest a value in itself: the engine charges for the elements that it visits, and not for those that one
//! list shares with another, so that a list of itself twice, made fifty times, takes 2^50 steps to print or compare.

use std::collections::{BTreeMap, BTreeSet};

/// Values that one variable may hold, shared ones counted each time.
const MAX_VALUES: u64 = 50_000;

/// Times that a value may be nested in itself outside of loops.
const MAX_NESTED: usize = 16;

/// Words that are neither variables nor calls.
const KEYWORDS: [&str; 16] = [
    "if",
    "else",
    "elif",
    "and",
    "or",
    "not",
    "in",
    "is",
    "true",
    "false",
    "none",
    "True",
    "False",
    "None",
    "recursive",
    "loop",
];

/// Functions and filters whose result holds their arguments.
const HOLDERS: [&str; 4] = ["dict", "namespace", "chain", "zip"];

/// What assigns to a variable, to a parameter or to an attribute of a namespace, which is spelled `.name`.
#[derive(Debug, Default)]
struct Assignment {
    targets: Vec<String>,
    mentions: Vec<Mention>,
    makes_namespace: bool,
    /// Whether it may happen more than once.
    is_repeated: bool,
}

/// A variable in an expression, with the attributes after it.
#[derive(Debug, Clone)]
struct Mention {
    path: Vec<String>,
    /// Whether the result holds it, in a list, a dictionary or a namespace.
    is_held: bool,
    /// Whether any attribute may be meant: nothing, or a subscript, follows.
    is_open: bool,
}

/// The assignments of a template, tag by tag.
#[derive(Debug, Default)]
pub(super) struct Nesting {
    assignments: Vec<Assignment>,
    /// Parameters by name of the macro; those of `call` are of `caller`, those of recursive loops of `loop`.
    parameters: BTreeMap<String, Vec<String>>,
    calls: Vec<(String, Assignment)>,
}

impl Nesting {
    /// Adds a tag: its first word, the text after that without string literals, and whether it is in a loop or a macro.
    pub(super) fn add(&mut self, word: &str, text: &str, is_repeated: bool) {
        let (targets, expression) = match word {
            "set" => split_at_equals(text),
            "for" => text.split_once(" in ").unwrap_or(("", text)),
            "with" => (text, text),
            "macro" | "call" => return self.add_parameters(word, text, is_repeated),
            _ => ("", text),
        };
        let read = Reader::read(expression, word == "for");
        let calls = read
            .calls
            .into_iter()
            .map(|(name, mentions)| (name, Assignment { mentions, is_repeated, ..Assignment::default() }));
        self.calls.extend(calls);
        let targets = match word {
            "with" => read.keywords,
            _ => targets_of(targets),
        };
        if word == "for" && read.is_recursive {
            self.parameters.entry("loop".to_owned()).or_default().extend(targets.clone());
        }
        if !targets.is_empty() {
            let Reader { mentions, makes_namespace, .. } = read.rest;
            self.assignments.push(Assignment { targets, mentions, makes_namespace, is_repeated });
        }
    }

    fn add_parameters(&mut self, word: &str, text: &str, is_repeated: bool) {
        let (name, list) = text.split_once('(').unwrap_or((text, ""));
        let name = if word == "call" { "caller" } else { name.trim() };
        let names = Reader::read(list, false);
        let keywords = names.keywords.into_iter();
        let all = names.rest.mentions.into_iter().filter_map(|mention| mention.path.into_iter().next()).chain(keywords);
        self.parameters.entry(name.to_owned()).or_default().extend(all);
        if word == "call" {
            self.add("", text, is_repeated);
        }
    }

    /// Whether a value is nested in itself again and again, or one holds too many. Called at the end of the template.
    pub(super) fn is_excessive(&mut self) -> bool {
        for (name, call) in std::mem::take(&mut self.calls) {
            let Some(parameters) = self.parameters.get(&name) else { continue };
            self.assignments.push(Assignment { targets: parameters.clone(), ..call });
        }
        let graph = Graph::new(&self.assignments);
        let mut nested = 0_usize;
        for one in &self.assignments {
            let is_self = one.mentions.iter().any(|m| m.is_held && graph.leads(m, &one.targets));
            if is_self && one.is_repeated {
                return true;
            }
            nested = nested.saturating_add(usize::from(is_self));
        }
        let mut sizes = BTreeMap::new();
        nested > MAX_NESTED || graph.nodes.iter().any(|node| graph.size(node, &mut sizes) > MAX_VALUES)
    }
}

/// The nodes are variables and attributes that the template assigns to.
struct Graph<'a> {
    assignments: &'a [Assignment],
    nodes: BTreeSet<&'a str>,
    namespaces: BTreeSet<&'a str>,
    /// For each node, the nodes that it is assigned from.
    edges: BTreeMap<&'a str, BTreeSet<&'a str>>,
}

impl<'a> Graph<'a> {
    fn new(assignments: &'a [Assignment]) -> Self {
        let nodes = assignments.iter().flat_map(|one| &one.targets).map(String::as_str).collect();
        let mut graph = Self { assignments, nodes, namespaces: BTreeSet::new(), edges: BTreeMap::new() };
        loop {
            let before = graph.namespaces.len();
            for one in assignments {
                let has = |mention: &Mention| {
                    mention.is_open && mention.path.first().is_some_and(|name| graph.namespaces.contains(name.as_str()))
                };
                if one.makes_namespace || one.mentions.iter().any(has) {
                    graph.namespaces.extend(one.targets.iter().map(String::as_str));
                }
            }
            if graph.namespaces.len() == before {
                break;
            }
        }
        for one in assignments {
            let from: BTreeSet<&str> = one.mentions.iter().flat_map(|mention| graph.of_mention(mention)).collect();
            for target in &one.targets {
                graph.edges.entry(target).or_default().extend(&from);
            }
        }
        graph
    }

    /// The nodes that a mention may mean.
    fn of_mention(&self, mention: &Mention) -> Vec<&'a str> {
        let names = mention.path.iter().enumerate();
        let names = names.map(|(i, name)| if i == 0 { name.clone() } else { format!(".{name}") });
        let mut meant: Vec<&str> = names.filter_map(|name| self.nodes.get(name.as_str()).copied()).collect();
        let is_namespace = mention.path.first().is_some_and(|name| self.namespaces.contains(name.as_str()));
        if mention.is_open && is_namespace {
            meant.extend(self.nodes.iter().filter(|node| node.starts_with('.')));
        }
        meant
    }

    /// Whether the value of a mention may hold one of the targets.
    fn leads(&self, mention: &Mention, targets: &[String]) -> bool {
        let mut pending = self.of_mention(mention);
        let mut seen = BTreeSet::new();
        while let Some(node) = pending.pop() {
            if targets.iter().any(|target| target == node) {
                return true;
            }
            if seen.insert(node) {
                pending.extend(self.edges.get(node).into_iter().flatten());
            }
        }
        false
    }

    /// The most values that a node holds, shared ones counted each time.
    fn size(&self, node: &'a str, sizes: &mut BTreeMap<&'a str, u64>) -> u64 {
        if let Some(known) = sizes.get(node) {
            return *known;
        }
        // Until it is known, a node that is assigned from itself counts once.
        sizes.insert(node, 1);
        let mut most = 1_u64;
        for one in self.assignments.iter().filter(|one| one.targets.iter().any(|target| target == node)) {
            let (mut held, mut whole) = (1_u64, 1_u64);
            for mention in &one.mentions {
                let each = self.of_mention(mention).into_iter().map(|from| self.size(from, sizes)).max().unwrap_or(1);
                if mention.is_held {
                    held = held.saturating_add(each);
                } else {
                    whole = whole.max(each);
                }
            }
            most = most.max(held.saturating_add(whole));
        }
        sizes.insert(node, most);
        most
    }
}

/// The text before and after the first `=` that assigns; without one, the tag begins a block, whose value is a string.
fn split_at_equals(text: &str) -> (&str, &str) {
    let is_single = |at: usize| !text.get(at.saturating_add(1)..).is_some_and(|rest| rest.starts_with('='));
    match text.find('=').filter(|at| is_single(*at)) {
        Some(at) => (text.get(..at).unwrap_or_default(), text.get(at.saturating_add(1)..).unwrap_or_default()),
        None => ("", ""),
    }
}

/// The names of targets: `a, b`, `namespace.attribute`.
fn targets_of(text: &str) -> Vec<String> {
    let one = |part: &str| {
        let part = part.trim_matches(|c: char| !is_word(c));
        match part.rsplit_once('.') {
            Some((_, attribute)) => format!(".{}", attribute.trim()),
            None => part.to_owned(),
        }
    };
    text.split(',').map(one).filter(|name| !name.is_empty()).collect()
}

const fn is_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_' || !c.is_ascii()
}

/// An open bracket.
#[derive(Debug, PartialEq, Eq)]
enum Open {
    /// A list or a dictionary.
    Literal,
    /// A subscript, a group, or a call that does not return its arguments.
    Plain,
    /// A call of a function by its name.
    Call(String),
}

/// Reads the names of an expression.
#[derive(Debug, Default)]
struct Reader {
    mentions: Vec<Mention>,
    makes_namespace: bool,
}

/// What a reader found.
#[derive(Debug, Default)]
struct Read {
    rest: Reader,
    /// Names before `=`.
    keywords: Vec<String>,
    /// Calls by name, with what their arguments mention.
    calls: Vec<(String, Vec<Mention>)>,
    is_recursive: bool,
}

impl Reader {
    fn read(text: &str, is_loop: bool) -> Read {
        let mut read = Read::default();
        let mut open: Vec<Open> = Vec::new();
        let mut joins = false;
        let (mut rest, mut before, mut is_operand) = (text, ' ', false);
        while let Some(c) = rest.chars().next() {
            if is_word(c) && !c.is_ascii_digit() {
                let (path, after) = path_of(rest);
                let next = after.trim_start();
                let name = path.first().cloned().unwrap_or_default();
                let is_keyword =
                    path.len() == 1 && KEYWORDS.contains(&name.as_str()) && !(name == "loop" && next.starts_with('('));
                let is_argument = next.starts_with('=') && !next.starts_with("==");
                if HOLDERS.contains(&name.as_str()) && before == '|' {
                    joins = true;
                }
                if is_keyword {
                    read.is_recursive |= is_loop && name == "recursive";
                } else if next.starts_with('(') && path.len() == 1 {
                    read.rest.makes_namespace |= name == "namespace";
                    read.calls.push((name.clone(), Vec::new()));
                    open.push(Open::Call(name));
                    (rest, before, is_operand) = (next.get(1..).unwrap_or_default(), '(', false);
                    continue;
                } else if is_argument {
                    read.keywords.push(name);
                } else if before != '|' {
                    let mut path = path;
                    if next.starts_with('(') {
                        path.pop(); // a method
                    }
                    let is_open = path.len() == 1 || next.starts_with('[');
                    read.mention(Mention { path, is_held: is_held(&open), is_open }, &open);
                }
                (rest, before, is_operand) = (after, 'a', !is_keyword);
                continue;
            }
            match c {
                '[' => open.push(if is_operand { Open::Plain } else { Open::Literal }),
                '{' => open.push(Open::Literal),
                '(' => open.push(Open::Plain),
                ']' | '}' | ')' => drop(open.pop()),
                _ => {}
            }
            rest = rest.get(c.len_utf8()..).unwrap_or_default();
            if !c.is_whitespace() {
                before = c;
                is_operand = is_word(c) || matches!(c, ']' | '}' | ')' | '\'' | '"');
            }
        }
        if joins {
            read.rest.mentions.iter_mut().for_each(|mention| mention.is_held = true);
        }
        read
    }
}

impl Read {
    fn mention(&mut self, mention: Mention, open: &[Open]) {
        for bracket in open {
            let Open::Call(name) = bracket else { continue };
            if let Some((_, mentions)) = self.calls.iter_mut().rfind(|(called, _)| called == name) {
                mentions.push(mention.clone());
            }
        }
        self.rest.mentions.push(mention);
    }
}

/// Whether a value here becomes an element of the result.
fn is_held(open: &[Open]) -> bool {
    open.iter().any(|bracket| match bracket {
        Open::Literal => true,
        Open::Plain => false,
        Open::Call(name) => HOLDERS.contains(&name.as_str()),
    })
}

/// The dotted path at the start of a text, and the text after it.
fn path_of(text: &str) -> (Vec<String>, &str) {
    let mut path = Vec::new();
    let mut rest = text;
    loop {
        let end = rest.find(|c| !is_word(c)).unwrap_or(rest.len());
        let (name, after) = rest.split_at_checked(end).unwrap_or((rest, ""));
        path.push(name.to_owned());
        match after.strip_prefix('.') {
            Some(next) if next.starts_with(|c: char| is_word(c) && !c.is_ascii_digit()) => rest = next,
            _ => return (path, after),
        }
    }
}
