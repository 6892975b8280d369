//! The stack machine of pickles, without imports and calls.
//!
//! It follows `torch/_weights_only_unpickler.py` of torch 2.15.0 where that accepts an opcode, and `Lib/pickle.py` of `CPython`
//! 3.13 elsewhere, so that what a pickle imports is found for every protocol.

use std::collections::{BTreeMap, HashMap};

use super::PickleGlobal;
use super::known::Known;
use super::opcode;
use super::value::{DictKind, Heap, Span, Value, number};
use crate::checkpoint::work::{Work, WorkExceeded};

/// Maximum number of values on the stack, and of marks.
const MAX_STACK: usize = 1 << 20;
/// Maximum number of values in the memo: 100 000 tensors have some 800 000.
const MAX_MEMO: usize = 1 << 21;
/// Maximum number of values that are kept.
const MAX_VALUES: usize = 1 << 22;
/// Maximum number of different attributes that a pickle imports; real ones import some twenty.
const MAX_GLOBALS: usize = 1000;

/// Maximum number of bytes of a name that is imported, or of the key of a storage; real ones have some forty.
const MAX_NAME: usize = 256;
/// Work of an opcode, of a call or an import besides its values, and of a value that is copied or looked at.
const OPCODE: u64 = 16;
pub(super) const CALL: u64 = 100;
pub(super) const VALUE: u64 = 8;

/// Why the machine stopped before the opcode STOP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stop {
    /// The bytes end.
    End,
    /// An opcode cannot be executed.
    Broken(&'static str),
    /// A limit is reached.
    TooLarge(&'static str),
}

impl From<WorkExceeded> for Stop {
    fn from(_: WorkExceeded) -> Self {
        Self::TooLarge("work")
    }
}

/// The layout of the persistent ids of a container.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StorageIds {
    /// `('storage', type, key, location, numel)`.
    Zip,
    /// The same with the metadata of a view.
    Legacy,
    /// None are allowed.
    None,
}

/// A machine and the values that its pickles built.
pub(super) struct Machine<'p> {
    bytes: &'p [u8],
    /// Position of the next byte.
    pub(super) at: usize,
    stack: Vec<Value>,
    /// Heights of the stack at the marks.
    marks: Vec<usize>,
    memo: HashMap<u32, Value>,
    pub(super) heap: Heap,
    pub(super) work: &'p mut Work,
    pub(super) ids: StorageIds,
    pub(super) globals: Vec<PickleGlobal>,
    /// What is known of each global.
    known: Vec<Known>,
    names: HashMap<(String, String), u32>,
    /// Offset of the first use of each opcode.
    first_use: [Option<u64>; 256],
    /// The first construct that is not modelled.
    pub(super) doubt: Option<String>,
    /// Offset of the opcode that is executed.
    pub(super) offset: u64,
}

impl<'p> Machine<'p> {
    /// A machine for `bytes`, for which the caller has granted the work.
    pub(super) fn new(bytes: &'p [u8], ids: StorageIds, work: &'p mut Work) -> Self {
        Self {
            bytes,
            at: 0,
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
            heap: Heap::default(),
            work,
            ids,
            globals: Vec::new(),
            known: Vec::new(),
            names: HashMap::new(),
            first_use: [None; 256],
            doubt: None,
            offset: 0,
        }
    }

    /// Executes one pickle from the current position on, and returns the value that it leaves.
    ///
    /// # Errors
    /// When the pickle does not reach its opcode STOP.
    pub(super) fn run(&mut self) -> Result<Value, Stop> {
        self.stack.clear();
        self.marks.clear();
        self.memo.clear();
        loop {
            self.offset = u64::try_from(self.at).unwrap_or(u64::MAX);
            let [op] = self.take::<1>()?;
            self.work.spend(1, OPCODE)?;
            if let Some(first) = self.first_use.get_mut(usize::from(op)) {
                first.get_or_insert(self.offset);
            }
            if op == b'.' {
                return self.pop();
            }
            if let Some(value) = self.constant(op)? {
                self.push(value)?;
            } else if !self.memoise(op)? && !self.rearrange(op)? && !self.collect(op)? {
                self.evaluate(op)?;
            }
            if self.heap.size() > MAX_VALUES {
                return Err(Stop::TooLarge("values"));
            }
        }
    }

    /// The opcodes that were executed, with the offset of the first use.
    pub(super) fn opcodes(&self) -> BTreeMap<&'static str, u64> {
        let used = (0..=u8::MAX).zip(&self.first_use);
        used.filter_map(|(op, first)| Some((opcode::name(op)?, (*first)?))).collect()
    }

    /// The text of a span.
    pub(super) fn text(&self, span: Span) -> &'p str {
        std::str::from_utf8(self.slice(span)).unwrap_or_default()
    }

    pub(super) fn slice(&self, span: Span) -> &'p [u8] {
        self.bytes.get(span.start as usize..span.end as usize).unwrap_or_default()
    }

    /// Notes a construct that is not modelled.
    pub(super) fn doubt(&mut self, what: impl FnOnce() -> String) {
        if self.doubt.is_none() {
            self.doubt = Some(what());
        }
    }

    /// What is known of a global.
    pub(super) fn known(&self, id: u32) -> Known {
        self.known.get(id as usize).copied().unwrap_or(Known::Other)
    }

    /// Module and name of a global, joined.
    pub(super) fn path(&self, id: u32) -> String {
        self.globals.get(id as usize).map(|g| format!("{}.{}", g.module, g.name)).unwrap_or_default()
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Stop> {
        let bytes = self.bytes.get(self.at..).and_then(<[u8]>::first_chunk).ok_or(Stop::End)?;
        self.at = self.at.saturating_add(N);
        Ok(*bytes)
    }

    fn span(&mut self, len: u64) -> Result<Span, Stop> {
        let len = usize::try_from(len).map_err(|_| Stop::End)?;
        let end = self.at.checked_add(len).filter(|end| *end <= self.bytes.len()).ok_or(Stop::End)?;
        let span = Span { start: number(self.at), end: number(end) };
        self.at = end;
        Ok(span)
    }

    fn text_span(&mut self, len: u64) -> Result<Value, Stop> {
        let span = self.span(len)?;
        if std::str::from_utf8(self.slice(span)).is_err() {
            return Err(Stop::Broken("a string is not valid UTF-8"));
        }
        Ok(Value::Text(span))
    }

    /// The bytes up to the next line feed, without it.
    fn line(&mut self) -> Result<Span, Stop> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let len = memchr::memchr(b'\n', rest).ok_or(Stop::End)?;
        let span = self.span(u64::try_from(len).unwrap_or(u64::MAX))?;
        self.at = self.at.saturating_add(1);
        Ok(span)
    }

    fn push(&mut self, value: Value) -> Result<(), Stop> {
        if self.stack.len() >= MAX_STACK {
            return Err(Stop::TooLarge("stack"));
        }
        self.stack.push(value);
        if let Value::Global(id) = value
            && let Some(global) = self.globals.get_mut(id as usize)
        {
            global.uses = global.uses.saturating_add(1);
        }
        Ok(())
    }

    fn floor(&self) -> usize {
        self.marks.last().copied().unwrap_or(0)
    }

    fn pop(&mut self) -> Result<Value, Stop> {
        if self.stack.len() <= self.floor() {
            return Err(Stop::Broken("the stack is empty"));
        }
        self.stack.pop().ok_or(Stop::Broken("the stack is empty"))
    }

    fn top(&self) -> Result<Value, Stop> {
        let top = if self.stack.len() > self.floor() { self.stack.last() } else { None };
        top.copied().ok_or(Stop::Broken("the stack is empty"))
    }

    fn pop_mark(&mut self) -> Result<Vec<Value>, Stop> {
        let at = self.marks.pop().ok_or(Stop::Broken("a mark is missing"))?;
        Ok(self.stack.split_off(at.min(self.stack.len())))
    }

    /// The value that an opcode pushes without looking at the stack; `None` for other opcodes.
    fn constant(&mut self, op: u8) -> Result<Option<Value>, Stop> {
        let value = match op {
            b'N' => Value::None,
            0x88 => Value::Bool(true),
            0x89 => Value::Bool(false),
            b'K' => Value::Int(i64::from(u8::from_le_bytes(self.take()?))),
            b'M' => Value::Int(i64::from(u16::from_le_bytes(self.take()?))),
            b'J' => Value::Int(i64::from(i32::from_le_bytes(self.take()?))),
            b'G' => {
                self.take::<8>()?;
                Value::Number
            }
            b'F' | b'I' | b'L' => {
                self.line()?;
                Value::Number
            }
            0x8a => {
                let [len] = self.take()?;
                let span = self.span(u64::from(len))?;
                long(self.slice(span))
            }
            0x8b => {
                let len = u32::from_le_bytes(self.take()?);
                let span = self.span(u64::from(len))?;
                long(self.slice(span))
            }
            b')' => self.heap.add_tuple(&[]),
            b']' => self.heap.add_list(Vec::new()),
            b'}' => self.heap.add_dict(DictKind::Plain),
            0x8f => Value::Set,
            _ => return self.string(op),
        };
        Ok(Some(value))
    }

    /// The string that an opcode pushes; `None` for other opcodes.
    fn string(&mut self, op: u8) -> Result<Option<Value>, Stop> {
        let value = match op {
            b'X' => {
                let len = u32::from_le_bytes(self.take()?);
                self.text_span(u64::from(len))?
            }
            b'U' | 0x8c => {
                let [len] = self.take()?;
                self.text_span(u64::from(len))?
            }
            0x8d => {
                let len = u64::from_le_bytes(self.take()?);
                self.text_span(len)?
            }
            b'S' => {
                let span = self.line()?;
                self.words(self.unquoted(span))
            }
            b'V' => {
                let span = self.line()?;
                self.words(span)
            }
            b'T' | b'B' => {
                let len = u32::from_le_bytes(self.take()?);
                Value::Bytes(self.span(u64::from(len))?)
            }
            b'C' => {
                let [len] = self.take()?;
                Value::Bytes(self.span(u64::from(len))?)
            }
            0x8e | 0x96 => {
                let len = u64::from_le_bytes(self.take()?);
                Value::Bytes(self.span(len)?)
            }
            _ => return Ok(None),
        };
        Ok(Some(value))
    }

    /// A string of protocol 0 without its quotes; escapes stay as they are.
    fn unquoted(&self, span: Span) -> Span {
        let text = self.slice(span);
        let is_quoted = text.len() >= 2 && matches!(text.first(), Some(b'\'' | b'"')) && text.first() == text.last();
        if is_quoted { Span { start: span.start.saturating_add(1), end: span.end.saturating_sub(1) } } else { span }
    }

    /// A line of text, or of bytes where it is not UTF-8.
    fn words(&self, span: Span) -> Value {
        if std::str::from_utf8(self.slice(span)).is_ok() { Value::Text(span) } else { Value::Bytes(span) }
    }

    /// Executes an opcode of the memo; `false` for other opcodes.
    fn memoise(&mut self, op: u8) -> Result<bool, Stop> {
        let (is_put, key) = match op {
            b'h' | b'q' => (op == b'q', u32::from(u8::from_le_bytes(self.take()?))),
            b'j' | b'r' => (op == b'r', u32::from_le_bytes(self.take()?)),
            b'g' | b'p' => {
                let span = self.line()?;
                let key = self.text(span).trim().parse().map_err(|_| Stop::Broken("a memo key is no number"))?;
                (op == b'p', key)
            }
            0x94 => (true, number(self.memo.len())),
            _ => return Ok(false),
        };
        if is_put {
            let value = self.top()?;
            if self.memo.len() >= MAX_MEMO {
                return Err(Stop::TooLarge("memo"));
            }
            self.memo.insert(key, value);
        } else {
            let value = self.memo.get(&key).copied().ok_or(Stop::Broken("a memo entry is missing"))?;
            self.push(value)?;
        }
        Ok(true)
    }

    /// Executes an opcode that only moves values on the stack; `false` for other opcodes.
    fn rearrange(&mut self, op: u8) -> Result<bool, Stop> {
        match op {
            b'(' => {
                if self.marks.len() >= MAX_STACK {
                    return Err(Stop::TooLarge("marks"));
                }
                self.marks.push(self.stack.len());
            }
            b'0' => drop(self.pop()?),
            b'1' => drop(self.pop_mark()?),
            b'2' => {
                let value = self.top()?;
                self.push(value)?;
            }
            0x80 => drop(self.take::<1>()?),
            0x95 => drop(self.take::<8>()?),
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Executes an opcode that fills containers; `false` for other opcodes.
    fn collect(&mut self, op: u8) -> Result<bool, Stop> {
        let value = match op {
            b't' => {
                let items = self.pop_mark()?;
                self.heap.add_tuple(&items)
            }
            0x85..=0x87 => {
                let mut items = Vec::with_capacity(3);
                for _ in 0x84..op {
                    items.push(self.pop()?);
                }
                items.reverse();
                self.heap.add_tuple(&items)
            }
            b'l' => {
                let items = self.pop_mark()?;
                self.heap.add_list(items)
            }
            b'd' => {
                let items = self.pop_mark()?;
                let dict = self.heap.add_dict(DictKind::Plain);
                self.set_items(dict, &items)?;
                dict
            }
            b'a' | b'e' => {
                let items = if op == b'a' { vec![self.pop()?] } else { self.pop_mark()? };
                return self.extend_list(items).map(|()| true);
            }
            b's' | b'u' => {
                let items = if op == b's' {
                    let value = self.pop()?;
                    vec![self.pop()?, value]
                } else {
                    self.pop_mark()?
                };
                let dict = self.top()?;
                return self.set_items(dict, &items).map(|()| true);
            }
            0x90 => {
                self.pop_mark()?;
                return self.top().map(|_| true);
            }
            0x91 => {
                self.pop_mark()?;
                Value::Set
            }
            _ => return Ok(false),
        };
        self.push(value)?;
        Ok(true)
    }

    fn extend_list(&mut self, items: Vec<Value>) -> Result<(), Stop> {
        match self.top()? {
            Value::List(id) => self.heap.extend_list(id, items).ok_or(Stop::Broken("a list is missing")),
            Value::Object => Ok(()),
            _ => Err(Stop::Broken("items are added to a value that is no list")),
        }
    }

    /// Sets the items, alternately keys and values, of a dict.
    pub(super) fn set_items(&mut self, target: Value, items: &[Value]) -> Result<(), Stop> {
        let (pairs, rest) = items.as_chunks::<2>();
        if !rest.is_empty() {
            return Err(Stop::Broken("a dict gets a key without a value"));
        }
        for [key, _] in pairs {
            if !self.is_hashable(*key, 0)? {
                return Err(Stop::Broken("a dict gets a key that cannot be hashed"));
            }
        }
        match target {
            Value::Dict(id) => self.heap.set_items(id, pairs).ok_or(Stop::Broken("a dict is missing")),
            Value::Object => Ok(()),
            _ => Err(Stop::Broken("items are set of a value that is no dict")),
        }
    }

    /// Whether Python can hash a value. Deep tuples count as hashable, with a doubt.
    fn is_hashable(&mut self, value: Value, depth: usize) -> Result<bool, Stop> {
        self.work.spend(2, VALUE)?;
        match value {
            Value::List(_) | Value::Dict(_) | Value::Set => return Ok(false),
            Value::Tuple(id) => {
                let len = self.heap.tuple(id).len();
                if depth > 4 || len > 16 {
                    self.doubt(|| "a key of a dict is a large tuple".to_owned());
                    return Ok(true);
                }
                for at in 0..len {
                    let item = self.heap.tuple(id).get(at).copied().unwrap_or(Value::None);
                    if !self.is_hashable(item, depth.saturating_add(1))? {
                        return Ok(false);
                    }
                }
            }
            // The readers of the dict hash and compare it a few times.
            Value::Text(span) => self.work.spend(self.slice(span).len(), 4)?,
            _ => {}
        }
        Ok(true)
    }

    /// Executes an opcode that imports, calls or sets the state of an object.
    fn evaluate(&mut self, op: u8) -> Result<(), Stop> {
        let value = match op {
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.import(module, name)?
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                match (module, name) {
                    (Value::Text(module), Value::Text(name)) => self.import(module, name)?,
                    _ => return Err(Stop::Broken("an import has no name")),
                }
            }
            b'R' | 0x81 => {
                let (arguments, function) = (self.pop()?, self.pop()?);
                self.call(function, arguments, op == 0x81)?
            }
            0x92 => {
                let (_keywords, arguments, class) = (self.pop()?, self.pop()?, self.pop()?);
                self.unmodelled_call(class, arguments)
            }
            b'i' => {
                let (module, name) = (self.line()?, self.line()?);
                let class = self.import(module, name)?;
                let arguments = self.pop_mark()?;
                let arguments = self.heap.add_tuple(&arguments);
                self.unmodelled_call(class, arguments)
            }
            b'o' => {
                let items = self.pop_mark()?;
                let (class, arguments) = items.split_first().ok_or(Stop::Broken("the stack is empty"))?;
                let arguments = self.heap.add_tuple(arguments);
                self.unmodelled_call(*class, arguments)
            }
            b'b' => {
                let (state, object) = (self.pop()?, self.pop()?);
                self.build(object, state)?
            }
            b'Q' => {
                let id = self.pop()?;
                self.storage(id)?
            }
            b'P' => return Err(Stop::Broken("a persistent id is text")),
            0x82..=0x84 | 0x97 | 0x98 => return Err(Stop::Broken("an opcode needs values from outside the pickle")),
            _ => return Err(Stop::Broken("a byte is no opcode")),
        };
        self.push(value)
    }

    /// The bytes of a name, which real pickles keep short.
    pub(super) fn short(&self, name: Span) -> Result<&'p [u8], Stop> {
        Some(self.slice(name)).filter(|name| name.len() <= MAX_NAME).ok_or(Stop::TooLarge("names"))
    }

    /// Records what a pickle imports.
    fn import(&mut self, module: Span, name: Span) -> Result<Value, Stop> {
        let (module, name) = (self.short(module)?, self.short(name)?);
        self.work.spend(1, CALL)?;
        let utf8 = |bytes| std::str::from_utf8(bytes).map_err(|_| Stop::Broken("a string is not valid UTF-8"));
        let (module, name) = (python3(utf8(module)?), utf8(name)?);
        self.global(module, name)
    }

    /// The attribute of a module, which is recorded at its first use.
    pub(super) fn global(&mut self, module: &str, name: &str) -> Result<Value, Stop> {
        let key = (module.to_owned(), name.to_owned());
        if let Some(id) = self.names.get(&key) {
            return Ok(Value::Global(*id));
        }
        if self.globals.len() >= MAX_GLOBALS {
            return Err(Stop::TooLarge("imports"));
        }
        let id = number(self.globals.len());
        let (module_name, attribute) = (module.to_owned(), name.to_owned());
        let offset = self.offset;
        let global = PickleGlobal { module: module_name, name: attribute, offset, ..PickleGlobal::default() };
        self.globals.push(global);
        self.known.push(Known::new(module, name));
        self.names.insert(key, id);
        Ok(Value::Global(id))
    }
}

/// The name in Python 3 of a module of Python 2. Source: `IMPORT_MAPPING` in `Lib/_compat_pickle.py`; only modules that
/// real pickles, or attacks, import.
fn python3(module: &str) -> &str {
    match module {
        "__builtin__" => "builtins",
        "copy_reg" => "copyreg",
        "commands" => "subprocess",
        "cPickle" => "pickle",
        other => other,
    }
}

/// An integer in two's complement, lowest byte first.
fn long(bytes: &[u8]) -> Value {
    let sign = bytes.last().is_some_and(|byte| *byte >= 0x80);
    let mut whole = if sign { [0xff; 8] } else { [0; 8] };
    match whole.get_mut(..bytes.len()) {
        Some(start) => {
            start.copy_from_slice(bytes);
            Value::Int(i64::from_le_bytes(whole))
        }
        None => Value::Number,
    }
}
