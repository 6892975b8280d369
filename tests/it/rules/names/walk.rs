//! Follows an expression with the types of the names that it sees, and finds names and keys that do not exist.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use cel::Env;
use cel::common::ast::{CallExpr, ComprehensionExpr, EntryExpr, Expr, IdedExpr, LiteralValue, SelectExpr, operators};
use ckpt_doctor::check::variables::FUNCTIONS;
use ckpt_doctor::knowledge::lists;
use ckpt_doctor::knowledge::source::nearest;
use serde_json::Value;

use super::types::{Field, Type};

static ENV: LazyLock<Env> = LazyLock::new(Env::stdlib);

/// A name that an expression uses and must not.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Problem {
    /// A variable, a function or a key that does not exist, and the nearest one that does.
    Unknown { name: String, what: String, near: Option<String> },
    /// A key in `has` or `get` that does not exist, which tests of other kinds of fault may have.
    Untestable { name: String, what: String, near: Option<String> },
    /// A key that may be missing, where nothing tests it.
    Untested { path: String },
    /// A `let` of a name that is bound already.
    Taken { name: String },
}

impl Problem {
    pub fn text(&self) -> String {
        match self {
            Self::Unknown { name, what, near } | Self::Untestable { name, what, near } => {
                let near = near.as_ref().map(|near| format!("; did you mean `{near}`?")).unwrap_or_default();
                format!("`{name}` is no {what}{near}")
            }
            Self::Taken { name } => format!("`{name}` has a value already"),
            Self::Untested { path } => format!("`{path}` may be missing; test it with `has({path})`"),
        }
    }
}

/// The names that an expression sees.
#[derive(Debug, Clone, Default)]
pub struct Names {
    pub variables: BTreeMap<String, Field>,
    /// Variables that stand for the keys of `fault`.
    pub details: BTreeSet<String>,
    /// Paths that a test before has shown to be present.
    pub present: BTreeSet<String>,
    /// A word for what has the keys of `fault`.
    pub of: String,
}

impl Names {
    pub fn bind(&mut self, name: &str, of: Type) {
        self.details.remove(name);
        self.variables.insert(name.to_owned(), Field::required(of));
    }

    /// These names where `expression` is true.
    pub fn where_true(&self, expression: &str) -> Self {
        let mut names = self.clone();
        names.present.extend(self.shown(&parse(expression), true));
        names
    }
}

fn parse(expression: &str) -> IdedExpr {
    // The program does not parse a path as CEL does, which reserves words such as `package`.
    let is_word = |word: &str| word.starts_with(|c: char| c.is_ascii_lowercase()) && word.chars().all(is_of_word);
    if !["true", "false", "null"].contains(&expression) && expression.split('.').all(is_word) {
        let mut words = expression.split('.');
        let expr = Expr::Ident(words.next().unwrap_or_default().to_owned());
        return words.fold(IdedExpr { id: 0, expr }, |operand, word| {
            let select = SelectExpr { operand: Box::new(operand), field: word.to_owned(), test: false };
            IdedExpr { id: 0, expr: Expr::Select(select) }
        });
    }
    let program = ENV.compile(expression).unwrap_or_else(|error| panic!("{expression}: {error:?}"));
    program.expression().clone()
}

const fn is_of_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_'
}

/// The type of an expression, and its problems.
pub fn type_of(expression: &str, names: &Names) -> (Type, Vec<Problem>) {
    let mut problems = Vec::new();
    let of = names.walk(&parse(expression), &mut problems);
    (of, problems)
}

/// Names of types, which are values in CEL.
const TYPES: [&str; 7] = ["int", "double", "string", "bool", "list", "map", "null_type"];

/// The functions of CEL and of all data files.
const STANDARD: [&str; 28] = [
    "size",
    "startsWith",
    "endsWith",
    "contains",
    "matches",
    "int",
    "double",
    "string",
    "type",
    "pow",
    "isqrt",
    "sqrt",
    "sum",
    "floor",
    "ceil",
    "range",
    "keys",
    "split",
    "zpad",
    "join",
    "plural",
    "filesize",
    "glob",
    "min",
    "max",
    "get",
    "bool",
    "uint",
];

impl Names {
    fn walk(&self, part: &IdedExpr, problems: &mut Vec<Problem>) -> Type {
        match &part.expr {
            Expr::Literal(LiteralValue::Boolean(flag)) => Type::Flag(Some(*flag.inner())),
            Expr::Literal(LiteralValue::String(text)) => Type::Text(Some(text.inner().to_owned())),
            Expr::Literal(LiteralValue::Null) => Type::Nothing,
            Expr::Literal(_) => Type::Number,
            Expr::Ident(name) => self.variable(name, problems),
            Expr::Select(SelectExpr { operand, field, test }) => {
                let base = self.walk(operand, problems);
                let path = self.path(operand).map(|path| format!("{path}.{field}"));
                if *test { self.test(&base, field, problems) } else { self.key(&base, field, path, problems) }
            }
            Expr::Call(call) => self.call(part, call, problems),
            Expr::Comprehension(l) => self.within_loop(l, problems),
            Expr::List(list) => {
                let all = list.elements.iter().map(|element| self.walk(element, problems));
                Type::list(all.fold(Type::Nothing, |all, one| all.or(&one.general())))
            }
            Expr::Map(map) => {
                let mut fields = BTreeMap::new();
                let mut values = Type::Nothing;
                for entry in &map.entries {
                    let EntryExpr::MapEntry(entry) = &entry.expr else { return Type::Any };
                    let (key, value) = (self.walk(&entry.key, problems), self.walk(&entry.value, problems).general());
                    values = values.or(&value);
                    if let Type::Text(Some(key)) = key {
                        fields.insert(key, Field::required(value));
                    }
                }
                if fields.len() == map.entries.len() { Type::Record(fields) } else { Type::Map(Box::new(values)) }
            }
            Expr::Struct(_) | Expr::Unspecified => Type::Any,
        }
    }

    fn variable(&self, name: &str, problems: &mut Vec<Problem>) -> Type {
        if name.starts_with('@') && !self.variables.contains_key(name) || TYPES.contains(&name) {
            return Type::Any;
        }
        let Some(field) = self.variables.get(name) else {
            let near = nearest(name, self.variables.keys().map(String::as_str)).map(str::to_owned);
            problems.push(Problem::Unknown { name: name.to_owned(), what: "variable".to_owned(), near });
            return Type::Any;
        };
        if !field.required && self.details.contains(name) {
            self.demand(&format!("fault.{name}"), problems);
        }
        field.of.clone()
    }

    fn demand(&self, path: &str, problems: &mut Vec<Problem>) {
        if !self.present.contains(path) {
            problems.push(Problem::Untested { path: path.to_owned() });
        }
    }

    /// The type of a value under a key.
    fn key(&self, base: &Type, key: &str, path: Option<String>, problems: &mut Vec<Problem>) -> Type {
        match base {
            Type::Any | Type::Nothing => Type::Any,
            Type::Map(of) => (**of).clone(),
            Type::Record(fields) => {
                let Some(field) = fields.get(key) else {
                    problems.push(self.unknown(key, fields, path.as_deref(), false));
                    return Type::Any;
                };
                if !field.required {
                    self.demand(&path.unwrap_or_else(|| key.to_owned()), problems);
                }
                field.of.clone()
            }
            Type::Flag(_) | Type::Text(_) | Type::Number | Type::List(_) => {
                let what = "key, because the value is no map".to_owned();
                problems.push(Problem::Unknown { name: key.to_owned(), what, near: None });
                Type::Any
            }
        }
    }

    /// Whether a key is present.
    fn test(&self, base: &Type, key: &str, problems: &mut Vec<Problem>) -> Type {
        let Type::Record(fields) = base else { return Type::Flag(None) };
        if let Some(field) = fields.get(key) {
            return Type::Flag(field.required.then_some(true));
        }
        problems.push(self.unknown(key, fields, None, true));
        Type::Flag(Some(false))
    }

    fn unknown(&self, key: &str, fields: &BTreeMap<String, Field>, path: Option<&str>, tested: bool) -> Problem {
        let near = nearest(key, fields.keys().map(String::as_str)).map(str::to_owned);
        let name = path.unwrap_or(key).to_owned();
        let what = format!("key{}", self.of);
        if tested {
            Problem::Untestable { name: key.to_owned(), what, near }
        } else {
            Problem::Unknown { name, what, near }
        }
    }

    fn call(&self, part: &IdedExpr, call: &CallExpr, problems: &mut Vec<Problem>) -> Type {
        let arguments: Vec<&IdedExpr> = call.target.as_deref().into_iter().chain(&call.args).collect();
        match (call.func_name.as_str(), arguments.as_slice()) {
            (operators::CONDITIONAL, [condition, then, otherwise]) => {
                let known = self.walk(condition, problems);
                let mut branch = |part: &IdedExpr, holds: bool| self.given(condition, holds).walk(part, problems);
                match known {
                    Type::Flag(Some(true)) => branch(then, true),
                    Type::Flag(Some(false)) => branch(otherwise, false),
                    _ => branch(then, true).or(&branch(otherwise, false)),
                }
            }
            (operators::LOGICAL_AND, [one, other]) => self.both(one, other, true, problems),
            (operators::LOGICAL_OR, [one, other]) => self.both(one, other, false, problems),
            (operators::LOGICAL_NOT, [one]) => match self.walk(one, problems) {
                Type::Flag(known) => Type::Flag(known.map(|flag| !flag)),
                _ => Type::Flag(None),
            },
            (operators::INDEX, [base, index]) => {
                let (base_type, index) = (self.walk(base, problems), self.walk(index, problems));
                match index {
                    Type::Text(Some(key)) => self.key(&base_type, &key, self.path(part), problems),
                    _ => base_type.element(),
                }
            }
            ("get", [map, key, default]) => {
                let (base, key) = (self.walk(map, problems), self.walk(key, problems));
                let default = self.walk(default, problems);
                match (base, key) {
                    (Type::Record(fields), Type::Text(Some(key))) => {
                        if let Some(field) = fields.get(&key) {
                            return field.of.or(&default).general();
                        }
                        problems.push(self.unknown(&key, &fields, None, true));
                        default
                    }
                    (base @ (Type::Map(_) | Type::Record(_)), _) => base.element().or(&default),
                    _ => Type::Any,
                }
            }
            ("listed", [name]) => list_type(&self.walk(name, problems), problems),
            (name, _) => {
                let types: Vec<Type> = arguments.iter().map(|argument| self.walk(argument, problems)).collect();
                result(name, &types, problems)
            }
        }
    }

    /// The names where a condition is true, or false.
    fn given(&self, condition: &IdedExpr, holds: bool) -> Self {
        let mut names = self.clone();
        names.present.extend(self.shown(condition, holds));
        names
    }

    /// `&&`, which one false side decides, or `||`, which one true side decides.
    fn both(&self, one: &IdedExpr, other: &IdedExpr, and: bool, problems: &mut Vec<Problem>) -> Type {
        let first = self.walk(one, problems);
        if first == Type::Flag(Some(!and)) {
            return first;
        }
        match (first, self.given(one, and).walk(other, problems)) {
            (_, second) if second == Type::Flag(Some(!and)) => second,
            (Type::Flag(Some(_)), second @ Type::Flag(_)) => second,
            _ => Type::Flag(None),
        }
    }

    fn within_loop(&self, l: &ComprehensionExpr, problems: &mut Vec<Problem>) -> Type {
        let range = self.walk(&l.iter_range, problems);
        let mut inner = self.clone();
        let element = match &range {
            // A loop over a map is one over its keys.
            Type::Map(_) | Type::Record(_) if l.iter_var2.is_none() => Type::Text(None),
            other => other.element(),
        };
        inner.bind(&l.iter_var, element);
        if let Some(second) = &l.iter_var2 {
            inner.bind(&l.iter_var, Type::Any);
            inner.bind(second, range.element());
        }
        let first = self.walk(&l.accu_init, problems).general();
        inner.bind(&l.accu_var, first.clone());
        let after = first.or(&inner.walk(&l.loop_step, problems)).general();
        inner.bind(&l.accu_var, after);
        inner.walk(&l.result, problems)
    }

    /// `a.b.c` of a variable and keys; a detail is a key of `fault`.
    fn path(&self, part: &IdedExpr) -> Option<String> {
        match &part.expr {
            Expr::Ident(name) if self.details.contains(name) => Some(format!("fault.{name}")),
            Expr::Ident(name) => Some(name.clone()),
            Expr::Select(SelectExpr { operand, field, test: false }) => {
                Some(format!("{}.{field}", self.path(operand)?))
            }
            Expr::Call(call) if call.func_name == operators::INDEX => match call.args.as_slice() {
                [base, key] => Some(format!("{}.{}", self.path(base)?, text(key)?)),
                _ => None,
            },
            _ => None,
        }
    }

    /// The paths that are present where a condition is true, or false.
    fn shown(&self, part: &IdedExpr, holds: bool) -> Vec<String> {
        let Expr::Call(call) = &part.expr else {
            return match &part.expr {
                Expr::Select(SelectExpr { operand, field, test: true }) if holds => {
                    self.path(operand).map(|path| format!("{path}.{field}")).into_iter().collect()
                }
                Expr::Select(SelectExpr { test: true, .. }) => Vec::new(),
                _ => self.read(part),
            };
        };
        match (call.func_name.as_str(), call.args.as_slice()) {
            (operators::LOGICAL_NOT, [one]) => self.shown(one, !holds),
            (operators::LOGICAL_AND, [one, other]) if holds => {
                [self.shown(one, true), self.shown(other, true)].concat()
            }
            (operators::LOGICAL_OR, [one, other]) if !holds => {
                [self.shown(one, false), self.shown(other, false)].concat()
            }
            (operators::LOGICAL_AND | operators::LOGICAL_OR | operators::CONDITIONAL, _) => Vec::new(),
            (operators::EQUALS | operators::NOT_EQUALS, [one, other]) => {
                let is_equal = holds == (call.func_name == operators::EQUALS);
                let of_get = self.defaulted(one).filter(|(_, default)| (**default == other.expr) != is_equal);
                [of_get.map(|(path, _)| path).into_iter().collect(), self.read(part)].concat()
            }
            _ => {
                let of_get = self.defaulted(part).filter(|(_, default)| {
                    matches!(default, Expr::Literal(LiteralValue::Boolean(flag)) if *flag.inner() != holds)
                });
                [of_get.map(|(path, _)| path).into_iter().collect(), self.read(part)].concat()
            }
        }
    }

    /// The path and the default of `get(map, 'key', default)`.
    fn defaulted<'e>(&self, part: &'e IdedExpr) -> Option<(String, &'e Expr)> {
        match &part.expr {
            Expr::Call(CallExpr { func_name, args, target: None }) if func_name == "get" => match args.as_slice() {
                [map, key, default] => Some((format!("{}.{}", self.path(map)?, text(key)?), &default.expr)),
                _ => None,
            },
            _ => None,
        }
    }

    /// The paths that an expression reads whatever the values are.
    fn read(&self, part: &IdedExpr) -> Vec<String> {
        if let Some(path) = self.path(part) {
            return vec![path];
        }
        match &part.expr {
            Expr::Call(call) if call.func_name == "get" => Vec::new(),
            Expr::Call(call)
                if [operators::LOGICAL_AND, operators::LOGICAL_OR, operators::CONDITIONAL]
                    .contains(&call.func_name.as_str()) =>
            {
                Vec::new()
            }
            Expr::Call(call) => {
                call.target.as_deref().into_iter().chain(&call.args).flat_map(|a| self.read(a)).collect()
            }
            Expr::Select(SelectExpr { operand, test: false, .. }) => self.read(operand),
            _ => Vec::new(),
        }
    }
}

/// The string of a literal.
fn text(part: &IdedExpr) -> Option<&str> {
    match &part.expr {
        Expr::Literal(LiteralValue::String(text)) => Some(text.inner()),
        _ => None,
    }
}

/// The type of the result of a function or an operator.
fn result(name: &str, arguments: &[Type], problems: &mut Vec<Problem>) -> Type {
    match (name, arguments) {
        (operators::EQUALS, [Type::Text(Some(one)), Type::Text(Some(other))]) => Type::Flag(Some(one == other)),
        (operators::NOT_EQUALS, [Type::Text(Some(one)), Type::Text(Some(other))]) => Type::Flag(Some(one != other)),
        (operators::ADD, [one @ Type::List(_), other @ Type::List(_)]) => one.or(other),
        ("keys" | "split", _) => Type::list(Type::Text(None)),
        (operators::ADD, [Type::Text(_), _] | [_, Type::Text(_)])
        | ("join" | "plural" | "filesize" | "string" | "zpad", _) => Type::Text(None),
        (operators::ADD, [Type::Any, _] | [_, Type::Any]) | ("type" | "min" | "max", _) => Type::Any,
        ("startsWith" | "endsWith" | "contains" | "matches" | "glob" | "bool", _) => Type::Flag(None),
        _ if STANDARD.contains(&name) => Type::Number,
        _ if name.starts_with(|c: char| c.is_ascii_alphabetic()) => of_rules(name, arguments.len(), problems),
        ("-_" | "_-_" | "_*_" | "_/_" | "_%_" | operators::ADD, _) => Type::Number,
        _ => Type::Flag(None),
    }
}

/// The type of a list of `rules/lists.json5`.
fn list_type(name: &Type, problems: &mut Vec<Problem>) -> Type {
    let unknown =
        |name: &str, what: &str, near| Problem::Unknown { name: name.to_owned(), what: what.to_owned(), near };
    let Type::Text(Some(name)) = name else {
        problems.push(unknown("listed", "function of a computed name", None));
        return Type::Any;
    };
    match lists::listed(name) {
        Some(Value::Array(_)) => Type::list(Type::Text(None)),
        Some(_) => Type::Map(Box::new(Type::Text(None))),
        None => {
            let near = nearest(name, lists::all().keys().map(String::as_str)).map(str::to_owned);
            problems.push(unknown(name, "list", near));
            Type::Any
        }
    }
}

/// The type of the result of a function of rules.
fn of_rules(name: &str, count: usize, problems: &mut Vec<Problem>) -> Type {
    let unknown = |what: String, near: Option<&str>| Problem::Unknown {
        name: name.to_owned(),
        what,
        near: near.map(str::to_owned),
    };
    let Some(function) = FUNCTIONS.iter().find(|function| function.name == name) else {
        let known = FUNCTIONS.iter().map(|function| function.name).chain(STANDARD);
        problems.push(unknown("function".to_owned(), nearest(name, known)));
        return Type::Any;
    };
    if function.parameters.len() != count {
        problems.push(unknown(format!("function of {}", plural(count)), None));
    }
    function.result.into()
}

fn plural(count: usize) -> String {
    format!("{count} argument{}", if count == 1 { "" } else { "s" })
}
