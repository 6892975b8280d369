//! Every name in every rule: variables, functions, and keys of faults, which are those that `FaultKind::details` and the
//! tables of `check::variables` declare.

mod types;
mod walk;

use std::collections::{BTreeMap, BTreeSet};

use ckpt_doctor::check::variables::VARIABLES;
use ckpt_doctor::checkpoint::FaultKind;
use ckpt_doctor::knowledge::rule::{Assert, Check, EditSpec, Effect, FaultCheck, Fix, RuleFile};
use ckpt_doctor::knowledge::{Expression, Template, source};

use crate::support::{project, texts};
use types::{Field, Type};
use walk::{Names, Problem, type_of};

/// Whether a place of a rule needs all its values.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Need {
    /// A value that is missing becomes `?` in a text.
    All,
    /// The place is left out, or counts as false.
    Some,
}

/// The problems of one rule, by the place where they are.
#[derive(Default)]
struct Found {
    problems: BTreeSet<(String, Problem)>,
}

impl Found {
    fn expression(&mut self, at: &str, expression: &Expression, names: &Names, need: Need) -> Type {
        let (of, problems) = type_of(expression.source(), names);
        let counts = |problem: &Problem| need == Need::All || !matches!(problem, Problem::Untested { .. });
        self.problems.extend(problems.into_iter().filter(counts).map(|problem| (at.to_owned(), problem)));
        of
    }

    fn template(&mut self, at: &str, template: Option<&Template>, names: &Names, need: Need) {
        for expression in template.into_iter().flat_map(Template::expressions) {
            self.expression(at, expression, names, need);
        }
    }

    /// Follows a condition; the names where it holds, or nothing when it never does.
    fn condition(&mut self, at: &str, condition: Option<&Expression>, names: &Names) -> Option<Names> {
        let Some(condition) = condition else { return Some(names.clone()) };
        let of = self.expression(at, condition, names, Need::Some);
        (of != Type::Flag(Some(false))).then(|| names.where_true(condition.source()))
    }

    fn effect(&mut self, at: &str, effect: &Effect, names: &Names) {
        if let Some(names) = self.condition(&format!("{at}.when"), effect.when.as_ref(), names) {
            self.template(&format!("{at}.{}", effect.consequence.name()), Some(&effect.text), &names, Need::All);
        }
    }

    /// Follows a fix; whether its condition holds for every finding.
    fn fix(&mut self, at: &str, fix: &Fix, names: &Names) -> bool {
        let is_certain = fix.when.as_ref().is_none_or(|when| type_of(when.source(), names).0 == Type::Flag(Some(true)));
        let Some(names) = self.condition(&format!("{at}.when"), fix.when.as_ref(), names) else { return false };
        self.template(&format!("{at}.title"), fix.title.as_ref(), &names, Need::All);
        self.template(&format!("{at}.help"), fix.help.as_ref(), &names, Need::All);
        self.condition(&format!("{at}.needs_whole_load"), fix.needs_whole_load.as_ref(), &names);
        let mut inner = names;
        if let Some(each) = &fix.each {
            let list = self.expression(&format!("{at}.each"), each, &inner, Need::Some);
            inner.bind("one", list.element());
        }
        for edit in &fix.edits {
            self.edit(&format!("{at}.edits"), edit, &inner);
        }
        is_certain
    }

    fn edit(&mut self, at: &str, edit: &EditSpec, names: &Names) {
        let (texts, value) = match edit {
            EditSpec::Set { file, pointer, to } => (vec![file, pointer], Some(to)),
            EditSpec::Remove { file, pointer } => (vec![file, pointer], None),
            EditSpec::Replace { with } => (vec![with], None),
            EditSpec::Rename(prefixes) => (Vec::new(), Some(prefixes)),
            EditSpec::Write { file, .. } => (vec![file], None),
            EditSpec::Create { file, to } => (vec![file], Some(to)),
            EditSpec::Repair(_) => (Vec::new(), None),
        };
        for text in texts {
            self.template(at, Some(text), names, Need::Some);
        }
        if let Some(value) = value {
            self.expression(at, value, names, Need::Some);
        }
    }

    /// Binds the names of a `let`, each of which is new.
    fn lets(&mut self, at: &str, lets: &[(String, Expression)], names: &mut Names) {
        for (name, expression) in lets {
            let at = format!("{at}.{name}");
            let of = self.expression(&at, expression, names, Need::All);
            if names.variables.contains_key(name) {
                self.problems.insert((at, Problem::Taken { name: name.clone() }));
            }
            names.bind(name, of);
        }
    }

    /// What a finding shows.
    fn finding(&mut self, rule: &RuleFile, names: &Names) {
        for (number, effect) in rule.effects.iter().enumerate() {
            self.effect(&format!("effects[{number}]"), effect, names);
        }
        self.template("message", Some(&rule.message), names, Need::All);
        for (number, detail) in rule.details.iter().enumerate() {
            self.template(&format!("details[{number}]"), Some(detail), names, Need::Some);
        }
        for (number, fix) in rule.fixes.iter().enumerate() {
            let is_certain = self.fix(&format!("fix[{number}]"), fix, names);
            // Those after it are never used.
            if is_certain && fix.edits.is_empty() {
                break;
            }
        }
    }

    fn fault(&mut self, rule: &RuleFile, check: &FaultCheck, kind: FaultKind, names: &Names) {
        let names = names_of_fault(kind, names);
        let of_fault = names_of_fault(kind, &Names::default()).variables;
        for (name, _) in rule.lets.iter().filter(|(name, _)| of_fault.contains_key(name)) {
            self.problems.insert((format!("let.{name}"), Problem::Taken { name: name.clone() }));
        }
        if let Some(mut names) = self.condition("check.fault.only", check.only.as_ref(), &names) {
            self.lets("check.fault.let", &check.lets, &mut names);
            if check.group {
                names.bind("faults", Type::list(type_of_faults(check)));
            }
            self.finding(rule, &names);
        }
    }

    fn assert(&mut self, rule: &RuleFile, check: &Assert, names: &Names) {
        let mut names = names.clone();
        if let Some(each) = &check.each {
            let list = self.expression("check.assert.each", each, &names, Need::Some);
            names.bind("it", list.element());
        }
        self.lets("check.assert.let", &check.lets, &mut names);
        self.expression("check.assert.that", &check.that, &names, Need::Some);
        for at in &check.at {
            for text in [&at.file, &at.pointer, &at.tensor] {
                self.template("check.assert.at", text.as_ref(), &names, Need::All);
            }
        }
        self.finding(rule, &names);
    }
}

/// The names that every rule sees.
fn names_of_check() -> Names {
    let variable =
        |v: &ckpt_doctor::check::variables::Variable| (v.name.to_owned(), Field::required(v.value_type.into()));
    Names { variables: VARIABLES.iter().map(variable).collect(), ..Names::default() }
}

/// Kind and first place of a fault.
fn own_names(kind: Option<FaultKind>) -> BTreeMap<String, Field> {
    let kind = ("kind", Type::Text(kind.map(|kind| kind.name().to_owned())));
    let place = ["file", "tensor", "pointer"].map(|name| (name, Type::Text(None)));
    [kind].into_iter().chain(place).map(|(name, of)| (name.to_owned(), Field::required(of))).collect()
}

/// The names that a rule sees of a fault of one kind.
fn names_of_fault(kind: FaultKind, names: &Names) -> Names {
    let mut names = names.clone();
    names.of = format!(" of {}", kind.name());
    names.variables.extend(own_names(Some(kind)));
    names.bind("count", Type::Number);
    let details = Type::record(kind.details());
    for (name, field) in &details {
        // A detail that is missing leaves the variable of the check in view.
        if field.required || !names.variables.contains_key(name) {
            names.details.insert(name.clone());
            names.variables.insert(name.clone(), field.clone());
        }
    }
    names.bind("fault", Type::Record(details));
    names
}

/// An element of `faults`.
fn type_of_faults(check: &FaultCheck) -> Type {
    let of_kind = |kind: &FaultKind| {
        let mut all = own_names(None);
        all.extend(Type::record(kind.details()));
        Type::Record(all)
    };
    check.kinds.iter().map(of_kind).fold(Type::Nothing, |all, one| all.or(&one))
}

/// The problems of a rule in its file, as `path: place: problem`.
fn problems(path: &str, text: &str) -> Vec<String> {
    let rule: RuleFile = source::parse(path, text).unwrap_or_else(|error| panic!("{error}"));
    let names = names_of_check();
    let mut found = Found::default();
    let mut names_where_run = found.condition("when", rule.when.as_ref(), &names).unwrap_or(names);
    found.lets("let", &rule.lets, &mut names_where_run);
    match &rule.check {
        Check::Fault(check) => {
            for kind in &check.kinds {
                found.fault(&rule, check, *kind, &names_where_run);
            }
            let declared: BTreeSet<&str> =
                check.kinds.iter().flat_map(|kind| kind.details()).map(|key| key.name).collect();
            // Another kind of the rule may have the key; details that cannot be rendered are left out.
            found.problems.retain(|(at, problem)| match problem {
                Problem::Untestable { name, .. } => !declared.contains(name.as_str()),
                Problem::Unknown { name, .. } if at.starts_with("details") => !declared.contains(name.as_str()),
                _ => true,
            });
        }
        Check::Assert(check) => found.assert(&rule, check, &names_where_run),
    }
    found.problems.iter().map(|(at, problem)| format!("{path}: {at}: {}", problem.text())).collect()
}

/// A rule on two kinds of fault, with these keys besides those that it needs.
fn of_rule(keys: &str) -> Vec<String> {
    let text = format!(
        "{{ code: 'ABC001', name: 'a-b', summary: 's', why: 'w', severity: 'info', check: {{ fault: \
         {{ kinds: ['index-missing', 'no-weights'] }} }}, {keys} }}"
    );
    problems("ABC001.json5", &text)
}

#[test]
fn a_misspelt_name_is_found_wherever_it_is() {
    for (keys, expected) in [
        (
            r#"message: "{kind == 'index-missing' ? indx : ''}""#,
            "ABC001.json5: message: `indx` is no variable; did you mean `index`?",
        ),
        (
            r#"message: "{kind == 'index-missing' ? fault.indx : ''}""#,
            "ABC001.json5: message: `fault.indx` is no key of index-missing; did you mean `index`?",
        ),
        ("message: 'm', when: \"confg.a == 1\"", "ABC001.json5: when: `confg` is no variable; did you mean `config`?"),
        (
            "message: 'm', when: \"arch in listed('layer-type')\"",
            "ABC001.json5: when: `layer-type` is no list; did you mean `layer-types`?",
        ),
        (
            "message: 'm', when: \"has_fil('a')\"",
            "ABC001.json5: when: `has_fil` is no function; did you mean `has_file`?",
        ),
        (
            "message: 'm', when: \"robot.features.exists(f, f.mod == 'a')\"",
            "ABC001.json5: when: `f.mod` is no key; did you mean `mode`?",
        ),
        (
            r#"message: "{has(fault.foriegn) ? 'a' : 'b'}""#,
            "ABC001.json5: message: `foriegn` is no key of no-weights; did you mean `foreign`?",
        ),
        (
            r#"message: "{get(fault, 'foriegn', [])}""#,
            "ABC001.json5: message: `foriegn` is no key of no-weights; did you mean `foreign`?",
        ),
        (
            "message: 'm', effects: [{ on: 'model', when: \"kind == 'no-weights' && modl\", raises: 'r' }]",
            "ABC001.json5: effects[0].when: `modl` is no variable; did you mean `model`?",
        ),
        (
            r#"message: 'm', fix: { safety: 'manual', help: "{kind == 'no-weights' ? join(fault.foreign) : ''}" }"#,
            "ABC001.json5: fix[0].help: `fault.foreign` may be missing; test it with `has(fault.foreign)`",
        ),
    ] {
        assert!(of_rule(keys).contains(&expected.to_owned()), "{keys}: {:#?}", of_rule(keys));
    }
    let tested = r#"message: "{kind == 'index-missing' ? index : has(fault.foreign) ? join(foreign) : ''}""#;
    assert_eq!(of_rule(tested), Vec::<String>::new());
}

#[test]
fn a_misspelt_key_of_an_element_is_found() {
    let check =
        "check: { assert: { each: \"[['/a', config]].map(p, {'at': p[0], 'part': p[1]})\", that: 'it.prt == 1' } }";
    let text = format!(
        "{{ code: 'ABC001', name: 'a-b', summary: 's', why: 'w', severity: 'info', {check}, message: '{{it.at}}' }}"
    );
    assert_eq!(
        problems("ABC001.json5", &text),
        ["ABC001.json5: check.assert.that: `it.prt` is no key; did you mean `part`?"]
    );
}

#[test]
fn a_let_binds_a_new_name() {
    for (keys, expected) in [
        (r#"message: "{size(wheels)}", let: { wheels: "loaders" }"#, vec![]),
        (
            r#"message: "{whels}", let: { wheels: "1" }"#,
            vec!["message: `whels` is no variable; did you mean `wheels`?"],
        ),
        ("message: 'm', let: { twice: 'ones', ones: '1' }", vec!["let.twice: `ones` is no variable"]),
        ("message: 'm', let: { config: '1' }", vec!["let.config: `config` has a value already"]),
        ("message: 'm', let: { index: '1' }", vec!["let.index: `index` has a value already"]),
    ] {
        let expected: Vec<String> = expected.iter().map(|problem| format!("ABC001.json5: {problem}")).collect();
        assert_eq!(of_rule(keys), expected, "{keys}");
    }
    let text = "{ code: 'ABC001', name: 'a-b', summary: 's', why: 'w', severity: 'info', check: { fault: { kinds: \
                ['no-weights'], only: 'others', let: { others: 'join(fault.foreign)', kind: '1' } } }, message: '{others}' }";
    assert_eq!(
        problems("ABC001.json5", text),
        [
            "ABC001.json5: check.fault.let.kind: `kind` has a value already",
            "ABC001.json5: check.fault.let.others: `fault.foreign` may be missing; test it with `has(fault.foreign)`",
            "ABC001.json5: check.fault.only: `others` is no variable",
        ]
    );
}

/// Conditions and advice on directories see the variables of rules.
#[test]
fn directories_name_only_what_is_declared() {
    let path = "rules/directories.json5";
    let text = std::fs::read_to_string(project().join(path)).expect("text");
    let file: serde_json::Value = source::parse(path, &text).unwrap_or_else(|error| panic!("{error}"));
    let (names, mut found) = (names_of_check(), Found::default());
    for kind in file["kinds"].as_array().expect("kinds") {
        if let Some(when) = kind["when"].as_str() {
            found.expression("when", &Expression::parse(when).expect("an expression"), &names, Need::Some);
        }
        if let Some(help) = kind["help"].as_str() {
            found.template("help", Some(&Template::parse(help).expect("a template")), &names, Need::All);
        }
    }
    assert_eq!(found.problems, BTreeSet::new());
}

#[test]
fn rules_name_only_what_is_declared() {
    let wrong: Vec<String> = texts("rules/checks").iter().flat_map(|(path, text)| problems(path, text)).collect();
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}
