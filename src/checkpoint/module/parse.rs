//! Reads a Python module with tree-sitter, within bounds.

use std::ops::ControlFlow;

use tree_sitter::{Node, ParseOptions, Parser, Tree, TreeCursor};

use super::{Import, PythonClass, PythonModule, RelativeImport, is_keyword};
use crate::checkpoint::fault::Faults;
use crate::checkpoint::lfs::LfsPointer;
use crate::checkpoint::{Fault, FaultKind, Place};

/// Maximum number of syntax nodes visited: some 3 MB of ordinary Python, ten times the largest known module.
const MAX_NODES: usize = 1_000_000;

/// Maximum number of bytes parsed, ten times the size of published modules: a syntax tree takes some 140 bytes for each
/// byte of brackets or one-letter statements.
const MAX_BYTES: usize = 512 << 10;

/// Maximum number of progress callbacks of the parser, which come about every hundred steps.
const MAX_PROGRESS: usize = 200_000;

/// Context of a statement.
#[derive(Debug, Clone, Copy, Default)]
struct StatementContext {
    guarded: bool,
    function: bool,
    class: bool,
}

impl PythonModule {
    /// Parses a module. Never fails: every problem becomes a fault.
    #[must_use]
    pub fn parse(name: impl Into<String>, bytes: &[u8]) -> Self {
        parse(name.into(), bytes)
    }
}

fn parse(name: String, bytes: &[u8]) -> PythonModule {
    let place = Place::file(&*name);
    if let Some(pointer) = LfsPointer::parse(bytes) {
        let fault = Fault::new(FaultKind::LfsPointer).at(place).with("oid", pointer.oid).with("size", pointer.size);
        return PythonModule::unread(name, fault);
    }
    let text = match std::str::from_utf8(bytes) {
        Ok(text) => text,
        Err(error) => {
            let fault = Fault::invalid_utf8(&name, bytes, error.valid_up_to());
            return PythonModule::unread(name, fault);
        }
    };
    let mut module = PythonModule { name, text: Some(text.into()), ..PythonModule::default() };
    let mut faults = Faults::default();
    if let Some(tree) = Some(text).filter(|text| text.len() <= MAX_BYTES).and_then(tree_of) {
        ModuleReader { text, module: &mut module, faults: &mut faults }.walk(&tree);
    } else {
        module.unread = true;
        faults.push(Fault::new(FaultKind::PythonTooComplex).at(place));
    }
    module.faults = faults.into_vec();
    module
}

/// The syntax tree; `None` when parsing exceeds [`MAX_PROGRESS`].
fn tree_of(text: &str) -> Option<Tree> {
    let mut parser = Parser::new();
    parser.set_language(&tree_sitter_python::LANGUAGE.into()).ok()?;
    let mut left = MAX_PROGRESS;
    let mut progress = |_: &tree_sitter::ParseState| {
        left = left.saturating_sub(1);
        if left == 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let options = ParseOptions::new().progress_callback(&mut progress);
    let bytes = text.as_bytes();
    parser.parse_with_options(&mut |at, _| bytes.get(at..).unwrap_or_default(), None, Some(options))
}

struct ModuleReader<'a> {
    text: &'a str,
    module: &'a mut PythonModule,
    faults: &'a mut Faults,
}

impl<'a> ModuleReader<'a> {
    /// Visits every node, without recursion.
    fn walk(&mut self, tree: &Tree) {
        let mut cursor = tree.walk();
        // The context that each open node gives to its children.
        let mut scopes = vec![StatementContext::default()];
        for _ in 0..MAX_NODES {
            let node = cursor.node();
            let scope = scopes.last().copied().unwrap_or_default();
            let inner = self.visit(node, scope);
            if let Some(inner) = inner
                && cursor.goto_first_child()
            {
                scopes.push(inner);
                continue;
            }
            if !self.next(&mut cursor, &mut scopes) {
                return;
            }
        }
        self.module.unread = true;
        self.faults.push(Fault::new(FaultKind::PythonTooComplex).at(Place::file(&*self.module.name)));
    }

    #[allow(clippy::unused_self, reason = "reads like the other steps")]
    fn next(&self, cursor: &mut TreeCursor<'_>, scopes: &mut Vec<StatementContext>) -> bool {
        while !cursor.goto_next_sibling() {
            if !cursor.goto_parent() {
                return false;
            }
            scopes.pop();
        }
        true
    }

    fn str(&self, node: Node<'_>) -> &'a str {
        self.text.get(node.byte_range()).unwrap_or_default()
    }

    /// Records the facts of one node; returns the context for its children, or `None` to skip them.
    fn visit(&mut self, node: Node<'_>, scope: StatementContext) -> Option<StatementContext> {
        // The grammar takes `async` and `await` for names, as Python before 3.7 did.
        let keyword = node.kind() == "identifier" && is_keyword(self.str(node));
        if node.is_error() || node.is_missing() || keyword {
            let start = node.start_byte();
            // An error node can span the rest of the file; the mistake is near its beginning.
            let rest = self.text.get(node.byte_range()).unwrap_or_default();
            let len = rest.find('\n').unwrap_or(rest.len());
            let place = Place::file(&*self.module.name).span(start..start.saturating_add(len));
            self.faults.push(Fault::new(FaultKind::PythonSyntax).at(place));
            return Some(scope);
        }
        let top = !scope.function && !scope.class;
        match node.kind() {
            "class_definition" => {
                self.class(node, scope);
                Some(StatementContext { class: true, ..scope })
            }
            "function_definition" => {
                if let Some(name) = node.child_by_field_name("name").filter(|_| top) {
                    let name = self.str(name).to_owned();
                    self.module.names.insert(name);
                }
                Some(StatementContext { function: true, ..scope })
            }
            "string" | "comment" => None,
            "try_statement" => Some(StatementContext { guarded: true, ..scope }),
            "if_statement" => {
                let test = node.child_by_field_name("condition").map_or("", |c| self.str(c));
                let guard = test.contains("TYPE_CHECKING") || test.contains("is_") && test.contains("available");
                Some(StatementContext { guarded: scope.guarded || guard, ..scope })
            }
            "import_statement" => {
                self.import(node, scope, top);
                Some(scope)
            }
            "import_from_statement" | "future_import_statement" => {
                self.import_from(node, scope, top);
                Some(scope)
            }
            "assignment" => {
                if let Some(left) = node.child_by_field_name("left").filter(|_| top) {
                    self.bind(left);
                }
                // In `a = b = c`, the second assignment is the right operand.
                Some(scope)
            }
            _ => Some(scope),
        }
    }

    /// Records the names that an assignment binds: a name, or a flat list of names.
    fn bind(&mut self, target: Node<'_>) {
        if target.kind() == "identifier" {
            let name = self.str(target).to_owned();
            self.module.names.insert(name);
        }
        let mut cursor = target.walk();
        let names: Vec<_> = target.named_children(&mut cursor).filter(|c| c.kind() == "identifier").collect();
        if matches!(target.kind(), "pattern_list" | "tuple_pattern" | "list_pattern") {
            for name in names {
                let name = self.str(name).to_owned();
                self.module.names.insert(name);
            }
        }
    }

    fn class(&mut self, node: Node<'_>, scope: StatementContext) {
        let Some(name) = node.child_by_field_name("name") else { return };
        if scope.function {
            return;
        }
        if !scope.class {
            let name = self.str(name).to_owned();
            self.module.names.insert(name);
        }
        let bases = node.child_by_field_name("superclasses").map_or_else(Vec::new, |list| {
            let mut cursor = list.walk();
            let bases = list.named_children(&mut cursor);
            bases
                .filter(|b| matches!(b.kind(), "identifier" | "attribute" | "subscript" | "call"))
                .map(|b| self.str(b).to_owned())
                .collect()
        });
        let tokenizer_class = node.child_by_field_name("body").and_then(|body| self.attribute(body, "tokenizer_class"));
        self.module.classes.push(PythonClass {
            name: self.str(name).to_owned(),
            name_span: name.byte_range(),
            span: node.byte_range(),
            bases,
            tokenizer_class,
        });
    }

    /// The strings assigned to `name` in a class body; the last assignment counts.
    fn attribute(&self, body: Node<'_>, name: &str) -> Option<Vec<String>> {
        let mut cursor = body.walk();
        let mut found = None;
        for statement in body.named_children(&mut cursor) {
            let Some(assignment) = statement.named_child(0).filter(|n| n.kind() == "assignment") else { continue };
            let left = assignment.child_by_field_name("left");
            if left.is_some_and(|l| self.str(l) == name)
                && let Some(right) = assignment.child_by_field_name("right")
            {
                found = self.strings(right);
            }
        }
        found
    }

    /// A string, or a tuple or list of strings.
    fn strings(&self, node: Node<'_>) -> Option<Vec<String>> {
        match node.kind() {
            "string" => Some(vec![self.string(node)?]),
            "parenthesized_expression" => self.strings(node.named_child(0)?),
            "tuple" | "list" | "expression_list" => {
                let mut cursor = node.walk();
                let items = node.named_children(&mut cursor);
                items.filter(|n| n.kind() != "comment").map(|n| self.string(n)).collect()
            }
            _ => None,
        }
    }

    /// The content of a plain string literal; `None` for one with escapes or interpolation.
    fn string(&self, node: Node<'_>) -> Option<String> {
        if node.kind() != "string" {
            return None;
        }
        let mut cursor = node.walk();
        let mut content = String::new();
        for part in node.named_children(&mut cursor) {
            match part.kind() {
                "string_start" | "string_end" => {}
                "string_content" if part.named_child_count() == 0 => content.push_str(self.str(part)),
                _ => return None,
            }
        }
        Some(content)
    }

    fn import(&mut self, node: Node<'_>, scope: StatementContext, top: bool) {
        let mut cursor = node.walk();
        let items: Vec<_> = node.children_by_field_name("name", &mut cursor).collect();
        for item in items {
            let dotted = item.child_by_field_name("name").unwrap_or(item);
            let module: String = self.str(dotted).chars().filter(|c| !c.is_whitespace()).collect();
            let package = module.split('.').next().unwrap_or_default().to_owned();
            if top {
                let bound =
                    item.child_by_field_name("alias").map_or_else(|| package.clone(), |a| self.str(a).to_owned());
                self.module.names.insert(bound);
            }
            let span = node.byte_range();
            let (guarded, nested) = (scope.guarded, scope.function);
            self.module.imports.push(Import { package, module, names: Vec::new(), span, guarded, nested });
        }
    }

    fn import_from(&mut self, node: Node<'_>, scope: StatementContext, top: bool) {
        let mut names = Vec::new();
        let mut cursor = node.walk();
        let items: Vec<_> = node.children_by_field_name("name", &mut cursor).collect();
        for item in items {
            let name = item.child_by_field_name("name").unwrap_or(item);
            names.push(self.str(name).to_owned());
            if top {
                let bound = self.str(item.child_by_field_name("alias").unwrap_or(name)).to_owned();
                self.module.names.insert(bound);
            }
        }
        let mut cursor = node.walk();
        if node.named_children(&mut cursor).any(|c| c.kind() == "wildcard_import") {
            names.push("*".to_owned());
            self.module.star_import |= top;
        }
        let Some(from) = node.child_by_field_name("module_name") else { return };
        let written: String = self.str(from).chars().filter(|c| !c.is_whitespace()).collect();
        let module = written.trim_start_matches('.');
        let level = written.len().saturating_sub(module.len());
        let (span, guarded) = (node.byte_range(), scope.guarded);
        if level == 0 {
            let package = module.split('.').next().unwrap_or_default().to_owned();
            let (module, nested) = (module.to_owned(), scope.function);
            self.module.imports.push(Import { package, module, names, span, guarded, nested });
        } else if module.is_empty() {
            for name in names {
                let import = RelativeImport { level, module: name, names: Vec::new(), span: span.clone(), guarded };
                self.module.relative_imports.push(import);
            }
        } else {
            self.module.relative_imports.push(RelativeImport {
                level,
                module: module.to_owned(),
                names,
                span,
                guarded,
            });
        }
    }
}
