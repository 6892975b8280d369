//! Values that a pickle builds.

use super::element::Element;

/// A range of the bytes of a pickle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Span {
    pub(super) start: u32,
    pub(super) end: u32,
}

/// A value. Containers are numbers of entries of the [`Heap`], so a copy of a value is a reference, and cycles are harmless.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Value {
    None,
    Bool(bool),
    Int(i64),
    /// A float, or an integer of more than 64 bits.
    Number,
    /// A string, which is valid UTF-8.
    Text(Span),
    Bytes(Span),
    Tuple(u32),
    List(u32),
    Set,
    Dict(u32),
    /// A module's attribute.
    Global(u32),
    Storage(u32),
    Tensor(u32),
    /// What a call that is not modelled returns.
    Object,
}

/// The kind of a dict: only some can be given attributes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DictKind {
    Plain,
    Ordered,
}

/// A dict with its entries in the order of insertion; a key may occur twice, and the last one counts.
#[derive(Debug)]
pub(super) struct Dict {
    pub(super) kind: DictKind,
    pub(super) entries: Vec<(Value, Value)>,
}

/// A storage as a persistent id names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct StorageRef {
    /// Key in the archive.
    pub(super) key: Span,
    pub(super) element: Element,
    /// Bytes of the whole storage.
    pub(super) bytes: u64,
    /// The part that is a view of it, in bytes; only in files of torch before 0.4.
    pub(super) view: Option<(u64, u64)>,
    /// Offset of the opcode.
    pub(super) offset: u64,
}

/// A tensor as `torch._utils._rebuild_tensor_v2` gets it. Counts are elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct TensorRef {
    pub(super) storage: u32,
    pub(super) element: Element,
    pub(super) offset: u64,
    /// Tuples of integers.
    pub(super) shape: u32,
    pub(super) strides: u32,
}

/// Everything that a pickle built.
#[derive(Debug, Default)]
pub(super) struct Heap {
    tuples: Vec<(u32, u32)>,
    items: Vec<Value>,
    lists: Vec<Vec<Value>>,
    pub(super) dicts: Vec<Dict>,
    /// Number of values in lists and dicts.
    held: usize,
    pub(super) storages: Vec<StorageRef>,
    pub(super) tensors: Vec<TensorRef>,
}

/// A position in a list as the number in a [`Value`].
pub(super) fn number(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

impl Heap {
    pub(super) fn add_tuple(&mut self, items: &[Value]) -> Value {
        let start = number(self.items.len());
        self.items.extend_from_slice(items);
        self.tuples.push((start, number(self.items.len())));
        Value::Tuple(number(self.tuples.len().saturating_sub(1)))
    }

    pub(super) fn add_list(&mut self, items: Vec<Value>) -> Value {
        self.held = self.held.saturating_add(items.len());
        self.lists.push(items);
        Value::List(number(self.lists.len().saturating_sub(1)))
    }

    /// Adds items to a list; `None` when there is no such list.
    pub(super) fn extend_list(&mut self, list: u32, items: Vec<Value>) -> Option<()> {
        let list = self.lists.get_mut(list as usize)?;
        self.held = self.held.saturating_add(items.len());
        list.extend(items);
        Some(())
    }

    /// Adds entries to a dict; `None` when there is no such dict.
    pub(super) fn set_items(&mut self, dict: u32, pairs: &[[Value; 2]]) -> Option<()> {
        let dict = self.dicts.get_mut(dict as usize)?;
        self.held = self.held.saturating_add(pairs.len().saturating_mul(2));
        dict.entries.extend(pairs.iter().map(|[key, value]| (*key, *value)));
        Some(())
    }

    pub(super) fn add_dict(&mut self, kind: DictKind) -> Value {
        self.dicts.push(Dict { kind, entries: Vec::new() });
        Value::Dict(number(self.dicts.len().saturating_sub(1)))
    }

    pub(super) fn add_storage(&mut self, storage: StorageRef) -> Value {
        self.storages.push(storage);
        Value::Storage(number(self.storages.len().saturating_sub(1)))
    }

    pub(super) fn add_tensor(&mut self, tensor: TensorRef) -> Value {
        self.tensors.push(tensor);
        Value::Tensor(number(self.tensors.len().saturating_sub(1)))
    }

    pub(super) fn tuple(&self, id: u32) -> &[Value] {
        let Some((start, end)) = self.tuples.get(id as usize) else { return &[] };
        self.items.get(*start as usize..*end as usize).unwrap_or_default()
    }

    pub(super) fn list(&self, id: u32) -> &[Value] {
        self.lists.get(id as usize).map_or(&[], Vec::as_slice)
    }

    pub(super) fn dict(&self, id: u32) -> &[(Value, Value)] {
        self.dicts.get(id as usize).map_or(&[], |dict| dict.entries.as_slice())
    }

    /// The numbers of a tuple of non-negative integers; `None` when it has anything else.
    pub(super) fn counts(&self, tuple: u32) -> Option<Vec<u64>> {
        let count = |value: &Value| match value {
            Value::Int(n) => u64::try_from(*n).ok(),
            _ => None,
        };
        self.tuple(tuple).iter().map(count).collect()
    }

    /// The memory of what is kept, in values of 16 bytes.
    pub(super) fn size(&self) -> usize {
        let containers = self.tuples.len().saturating_add(self.lists.len()).saturating_add(self.dicts.len());
        let views = self.storages.len().saturating_add(self.tensors.len());
        let values = self.items.len().saturating_add(self.held);
        values.saturating_add(containers.saturating_mul(2)).saturating_add(views.saturating_mul(4))
    }
}
