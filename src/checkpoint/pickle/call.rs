//! The calls that build state dicts, modelled one by one. Every other call gives [`Value::Object`] and a doubt.
//!
//! Source: `torch/_utils.py` and `torch/serialization.py` of torch 2.15.0.

use super::element::Element;
use super::known::Known;
use super::machine::{CALL, Machine, Stop, StorageIds, VALUE};
use super::value::{DictKind, StorageRef, TensorRef, Value};

/// Maximum number of arguments of a call that is modelled, and of fields of a persistent id.
const MAX_ARGUMENTS: usize = 8;
/// Maximum number of dimensions; most functions of torch take no more. Source: `dim_bitset_size` in
/// `ATen/WrapDimUtilsMulti.h` of torch 2.15.0.
const MAX_DIMENSIONS: usize = 64;
/// Work of a tensor and of a storage for the readers, who look at each several times.
const VIEW: u64 = 600;

impl Machine<'_> {
    /// Calls a function, or creates an object of a class.
    pub(super) fn call(&mut self, function: Value, arguments: Value, is_new: bool) -> Result<Value, Stop> {
        let (Value::Global(id), Value::Tuple(tuple)) = (function, arguments) else {
            return Ok(self.unmodelled_call(function, arguments));
        };
        self.work.spend(1, CALL)?;
        let items: Vec<Value> = self.heap.tuple(tuple).iter().take(MAX_ARGUMENTS.saturating_add(1)).copied().collect();
        let result = match (self.known(id), items.as_slice()) {
            (Known::OrderedDict, []) => Some(self.heap.add_dict(DictKind::Ordered)),
            (Known::OrderedDict, [Value::List(pairs)]) if !is_new => self.ordered(*pairs)?,
            _ if is_new => None,
            (Known::Getattr, [Value::Global(class), Value::Text(name)]) => return self.member(id, *class, *name),
            (Known::Layout, [Value::Text(_)]) => Some(Value::Object),
            (Known::Size, [Value::Tuple(sizes)]) => {
                self.work.spend(self.heap.tuple(*sizes).len(), VALUE)?;
                self.heap.counts(*sizes).map(|_| Value::Tuple(*sizes))
            }
            (Known::Rebuild, [storage, offset, shape, strides]) => {
                self.tensor([*storage, *offset, *shape, *strides], None)?
            }
            (Known::RebuildV2, [storage, offset, shape, strides, gradient, hooks, more @ ..]) if more.len() < 2 => {
                let tensor = self.tensor([*storage, *offset, *shape, *strides], None)?;
                self.with_gradient(tensor, *gradient, *hooks, more)?
            }
            (Known::RebuildV3, [storage, offset, shape, strides, gradient, hooks, dtype, more @ ..])
                if more.len() < 2 =>
            {
                let element = match dtype {
                    Value::Global(id) => match self.known(*id) {
                        Known::Dtype(element) => Some(element),
                        _ => None,
                    },
                    _ => None,
                };
                match element {
                    // `torch.empty(…, requires_grad=True).set_(…)` raises.
                    Some(_) if *gradient == Value::Bool(true) => {
                        return Err(Stop::Broken("a tensor of a new type requires a gradient"));
                    }
                    Some(element) => {
                        let tensor = self.tensor([*storage, *offset, *shape, *strides], Some(element))?;
                        self.with_gradient(tensor, *gradient, *hooks, more)?
                    }
                    None => None,
                }
            }
            (Known::RebuildParameter, [tensor @ Value::Tensor(_), gradient, hooks]) => {
                self.with_gradient(Some(*tensor), *gradient, *hooks, &[])?
            }
            _ => None,
        };
        if let (Some(result), Some(global)) = (result, self.globals.get_mut(id as usize)) {
            global.called = true;
            return Ok(result);
        }
        Ok(self.unmodelled_call(function, arguments))
    }

    /// A call that is not modelled.
    pub(super) fn unmodelled_call(&mut self, function: Value, _arguments: Value) -> Value {
        if let Value::Global(id) = function {
            if let Some(global) = self.globals.get_mut(id as usize) {
                global.called = true;
            }
            if self.doubt.is_none() {
                self.doubt = Some(format!("it calls {}", self.path(id)));
            }
        } else {
            self.doubt(|| "it calls a value that is no import".to_owned());
        }
        Value::Object
    }

    /// A dict from a list of pairs.
    fn ordered(&mut self, pairs: u32) -> Result<Option<Value>, Stop> {
        self.work.spend(self.heap.list(pairs).len(), VALUE)?;
        let pairs = self.heap.list(pairs).to_vec();
        let mut items = Vec::with_capacity(pairs.len().saturating_mul(2));
        for pair in pairs {
            let pair = match pair {
                Value::List(id) => self.heap.list(id),
                Value::Tuple(id) => self.heap.tuple(id),
                _ => return Ok(None),
            };
            let [key, value] = pair else { return Ok(None) };
            items.extend([*key, *value]);
        }
        let dict = self.heap.add_dict(DictKind::Ordered);
        self.set_items(dict, &items)?;
        Ok(Some(dict))
    }

    /// A view of a storage, by storage, offset, shape and strides; `element` is a type other than the storage's.
    fn tensor(&mut self, arguments: [Value; 4], element: Option<Element>) -> Result<Option<Value>, Stop> {
        let [Value::Storage(storage), Value::Int(offset), Value::Tuple(shape), Value::Tuple(strides)] = arguments
        else {
            return Ok(None);
        };
        let negative = Stop::Broken("a tensor has a negative size, stride or offset");
        let offset = u64::try_from(offset).map_err(|_| negative)?;
        self.work.spend(1, VIEW)?;
        if [shape, strides].iter().any(|list| self.heap.tuple(*list).len() > MAX_DIMENSIONS) {
            return Err(Stop::TooLarge("dimensions"));
        }
        let (Some(sizes), Some(steps)) = (self.heap.counts(shape), self.heap.counts(strides)) else {
            return Err(negative);
        };
        if sizes.len() != steps.len() {
            return Err(Stop::Broken("a tensor has another number of sizes than of strides"));
        }
        let Some(found) = self.heap.storages.get(storage as usize) else { return Ok(None) };
        let element = element.unwrap_or(found.element);
        Ok(Some(self.heap.add_tensor(TensorRef { storage, element, offset, shape, strides })))
    }

    /// The same tensor, if its gradient, hooks and metadata are those of a plain one.
    fn with_gradient(
        &mut self,
        tensor: Option<Value>,
        gradient: Value,
        hooks: Value,
        metadata: &[Value],
    ) -> Result<Option<Value>, Stop> {
        let Some(Value::Tensor(id)) = tensor else { return Ok(None) };
        let is_empty = |value: &Value| match value {
            Value::None => true,
            Value::Dict(id) => self.heap.dict(*id).is_empty(),
            _ => false,
        };
        if !metadata.iter().all(is_empty) || !is_empty(&hooks) {
            return Ok(None);
        }
        let differentiable = self.heap.tensors.get(id as usize).is_some_and(|tensor| tensor.element.is_differentiable);
        match gradient {
            Value::Bool(true) if !differentiable => Err(Stop::Broken("a tensor of integers requires a gradient")),
            Value::Bool(_) => Ok(tensor),
            _ => Ok(None),
        }
    }

    /// Sets the state of an object: attributes of an ordered dict, which loaders keep for `_metadata`.
    pub(super) fn build(&mut self, object: Value, state: Value) -> Result<Value, Stop> {
        match (object, state) {
            (Value::Dict(id), Value::Dict(_))
                if self.heap.dicts.get(id as usize).is_some_and(|dict| dict.kind == DictKind::Ordered) =>
            {
                Ok(object)
            }
            (Value::Object | Value::Global(_) | Value::Tensor(_) | Value::Dict(_), _) => {
                self.doubt(|| "it sets the state of an object".to_owned());
                Ok(if matches!(object, Value::Dict(_)) { object } else { Value::Object })
            }
            _ => Err(Stop::Broken("the state of a plain value is set")),
        }
    }

    /// The storage of a persistent id.
    pub(super) fn storage(&mut self, id: Value) -> Result<Value, Stop> {
        const OTHER: Stop = Stop::Broken("a persistent id names no storage");
        let (Value::Tuple(id), StorageIds::Zip | StorageIds::Legacy) = (id, self.ids) else { return Err(OTHER) };
        self.work.spend(1, VIEW)?;
        let items: Vec<Value> = self.heap.tuple(id).iter().take(MAX_ARGUMENTS).copied().collect();
        let (fields, view) = match (self.ids, items.as_slice()) {
            (StorageIds::Zip, [word, class, key, location, numel]) => {
                ([word, class, key, location, numel], Value::None)
            }
            (StorageIds::Legacy, [word, class, key, location, numel, view]) => {
                ([word, class, key, location, numel], *view)
            }
            _ => return Err(OTHER),
        };
        let [Value::Text(word), Value::Global(class), Value::Text(key), Value::Text(_), Value::Int(numel)] = fields
        else {
            return Err(OTHER);
        };
        if self.slice(*word) != b"storage" {
            return Err(OTHER);
        }
        self.short(*key)?;
        let element = match (self.known(*class), self.ids) {
            (Known::Storage(element), _) => element,
            (Known::Untyped, StorageIds::Zip) => Element::BYTES,
            _ => {
                let path = self.path(*class);
                self.doubt(|| format!("it has a storage of {path}"));
                return Ok(Value::Object);
            }
        };
        let bytes = u64::try_from(*numel).ok().and_then(|numel| numel.checked_mul(element.width));
        let bytes = bytes.ok_or(Stop::Broken("a storage has an impossible size"))?;
        let view = self.view(view, element)?;
        let storage = StorageRef { key: *key, element, bytes, view, offset: self.offset };
        Ok(self.heap.add_storage(storage))
    }

    /// Start and length in bytes of a view of a storage, from `(key, offset, size)`.
    fn view(&self, view: Value, element: Element) -> Result<Option<(u64, u64)>, Stop> {
        let malformed = Stop::Broken("the view of a storage is malformed");
        let fields = match view {
            Value::None => return Ok(None),
            Value::Tuple(id) => self.heap.tuple(id),
            _ => return Err(malformed),
        };
        let [_, Value::Int(offset), Value::Int(size)] = fields else { return Err(malformed) };
        let bytes = |n: &i64| u64::try_from(*n).ok().and_then(|n| n.checked_mul(element.width)).ok_or(malformed);
        Ok(Some((bytes(offset)?, bytes(size)?)))
    }
}
