//! The adapter of PEFT that an entry of a recipe merges into a base model: where each of its tensors goes.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::error::MergeError;
use super::named::AnnouncedCast;
use super::parts::Donor;
use crate::check::adapter::lora::{Lora, LoraModule, LoraUse, lora};
use crate::checkpoint::adapter::Adapter;
use crate::checkpoint::{Shard, Tensor, files};
use crate::knowledge::{ExpectedTensor, Library, Loader};
use crate::surgery::expr::{Factor, Product, TensorExpr};
use crate::surgery::tensor_ref::TensorRef;

/// What an adapter makes of the tensors of its base model.
pub(super) struct MergedAdapter {
    /// Role of the adapter.
    pub(super) role: String,
    /// By the name of the base model's tensor.
    changed: BTreeMap<String, TensorExpr<TensorRef>>,
    /// Types of the base model's tensors that the adapter's own replace.
    pub(super) casts: Vec<AnnouncedCast>,
}

/// The two donors while the tensors of one are placed in the other.
struct Pair<'a> {
    base: &'a Donor,
    adapter: &'a Donor,
    /// The file of the adapter's tensors.
    shard: &'a Shard,
    /// The tensors of the base model by name.
    tensors: BTreeMap<&'a str, (&'a Shard, &'a Tensor)>,
    /// Last parts of the names of modules whose weight is `[in, out]`.
    turned: Vec<String>,
    /// Tensors that the class of the base model shares; `None` when the class is not known.
    shared: Option<BTreeSet<String>>,
}

impl MergedAdapter {
    /// Places the adapter of one donor in another one; `turned` are the last parts of the names of modules whose weight is
    /// `[in, out]`.
    ///
    /// # Errors
    /// [`MergeError::Donor`] when the adapter is none that can be merged, or does not fit the base model.
    pub(super) fn place(
        base: &Donor,
        adapter: &Donor,
        turned: Vec<String>,
        library: &Library,
    ) -> Result<Self, MergeError> {
        let refuse = |reason: String| MergeError::Donor(format!("the {} donor {reason}", adapter.role));
        if Adapter::from_checkpoint(&base.checkpoint).is_some() {
            return Err(MergeError::Donor(format!(
                "the {} donor is an adapter itself, or has one beside it; give the model that the adapter was trained on",
                base.role
            )));
        }
        let lora = lora(&adapter.checkpoint, LoraUse::Merge).map_err(refuse)?;
        let tensors =
            base.checkpoint.tensors().map(|(shard, tensor)| (tensor.name.as_str(), (shard, tensor))).collect();
        let file = Adapter::from_checkpoint(&adapter.checkpoint).and_then(|adapter| adapter.file());
        let shard = file.and_then(|file| adapter.checkpoint.shards.get(file));
        let shard = shard.ok_or_else(|| refuse("has no weights".to_owned()))?;
        let pair = Pair { base, adapter, shard, tensors, turned, shared: shared(base, library) };
        pair.changes(&lora).map_err(refuse)
    }

    /// The values of a tensor of the base model; `None` when they stay as they are.
    pub(super) fn source(&self, name: &str) -> Option<&TensorExpr<TensorRef>> {
        self.changed.get(name)
    }

    /// The tensors of the base model that change, by name.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.changed.keys().map(String::as_str)
    }
}

impl Pair<'_> {
    fn changes(&self, lora: &Lora<'_>) -> Result<MergedAdapter, String> {
        let (mut changed, mut casts) = (BTreeMap::new(), Vec::new());
        for (name, module) in &lora.modules {
            let (shard, tensor) = self.tensor(&format!("{name}.weight"))?;
            let is_turned = self.turned.iter().any(|end| name.rsplit('.').next() == Some(end));
            let source = self.product(shard, tensor, module, is_turned)?;
            source.typed().map_err(|reason| format!("cannot be merged into {}: {reason}", tensor.name))?;
            self.is_alone(tensor, module.is_embedding)?;
            changed.insert(tensor.name.clone(), source);
        }
        for (name, own) in &lora.whole {
            let (_, tensor) = self.tensor(name)?;
            if own.shape != tensor.shape {
                return Err(format!(
                    "has {name} of shape {:?}, and the {} donor {:?}: the base model was resized before training; resize it, and save it as the base",
                    own.shape, self.base.role, tensor.shape
                ));
            }
            self.is_alone(tensor, false)?;
            let of = self.of_adapter(own)?;
            let source = TensorExpr::Stored(of).converted(own.dtype, None, tensor.dtype);
            source.typed().map_err(|reason| format!("cannot replace {}: {reason}", tensor.name))?;
            casts.extend(
                (own.dtype != tensor.dtype)
                    .then(|| AnnouncedCast { donor: self.adapter.role.clone(), to: tensor.dtype.name().to_owned() }),
            );
            if changed.insert(tensor.name.clone(), source).is_some() {
                return Err(format!("has {} as a whole and as matrices", tensor.name));
            }
        }
        Ok(MergedAdapter { role: self.adapter.role.clone(), changed, casts })
    }

    /// The tensor of the base model that PEFT means by a name: the same one, or the one without its first part where the base
    /// model was saved without it, as GPT-2 on the Hub.
    fn tensor(&self, name: &str) -> Result<(&Shard, &Tensor), String> {
        let inner = || {
            let (prefix, inner) = name.split_once('.')?;
            let is_stored = self.tensors.keys().any(|stored| stored.split('.').next() == Some(prefix));
            self.tensors.get(inner).filter(|_| !is_stored)
        };
        let found = self.tensors.get(name).or_else(inner).copied();
        found.ok_or_else(|| format!("changes {name}, which the {} donor does not store", self.base.role))
    }

    fn of_adapter(&self, tensor: &Tensor) -> Result<TensorRef, String> {
        TensorRef::new(&self.adapter.role, self.adapter.checkpoint.source.path(), self.shard, tensor, None)
    }

    /// A weight with the product of a module's matrices added: `B @ A`, or its transpose where the weight is `[in, out]`.
    fn product(
        &self,
        shard: &Shard,
        weight: &Tensor,
        module: &LoraModule<'_>,
        is_turned: bool,
    ) -> Result<TensorExpr<TensorRef>, String> {
        let of = TensorRef::new(&self.base.role, self.base.checkpoint.source.path(), shard, weight, None)?;
        let (a, b) = (self.of_adapter(module.a)?, self.of_adapter(module.b)?);
        let (left, right) = if is_turned || module.is_embedding {
            (Factor::Transposed(a), Factor::Transposed(b))
        } else {
            (Factor::Stored(b), Factor::Stored(a))
        };
        // An embedding rounds the product to its type before it adds it.
        let product = Product { left, right, scale: module.scaling, rounded: module.is_embedding };
        Ok(TensorExpr::AddProduct { to: Box::new(TensorExpr::Stored(of)), product })
    }

    /// Fails for a tensor that the class of the base model shares, such as an embedding that is also the head: PEFT changes one of
    /// the two, and a loader ties them again. In a model of an unknown class, any tensor with a row for each token may be one.
    fn is_alone(&self, tensor: &Tensor, is_embedding: bool) -> Result<(), String> {
        if let Some(shared) = &self.shared {
            // The stored name may lack its first part.
            let is_named = |name: &String| {
                name.strip_suffix(&tensor.name).is_some_and(|before| before.is_empty() || before.ends_with('.'))
            };
            return if shared.iter().any(is_named) { Err(self.refusal(tensor)) } else { Ok(()) };
        }
        let config = &self.base.config;
        let places = ["", "/text_config"].map(|place| config.pointer(place).unwrap_or(&Value::Null));
        let of_any = |key: &str| places.iter().filter_map(|place| place.get(key)).collect::<Vec<_>>();
        let has_rows = of_any("vocab_size").iter().any(|size| size.as_u64() == tensor.shape.first().copied());
        let ties = of_any("tie_word_embeddings");
        let is_tied = ties.is_empty() || ties.contains(&&Value::Bool(true));
        if (is_embedding || has_rows) && is_tied { Err(self.refusal(tensor)) } else { Ok(()) }
    }

    fn refusal(&self, tensor: &Tensor) -> String {
        format!(
            "changes {}, which the {} donor shares between its embedding and its head; save the base model with tie_word_embeddings=False and two tensors",
            tensor.name, self.base.role
        )
    }
}

/// The names of tensors that the class of a donor shares, in the version of transformers that its config names.
fn shared(base: &Donor, library: &Library) -> Option<BTreeSet<String>> {
    let config = base.checkpoint.document(files::CONFIG)?.value.as_ref()?;
    let names = base.checkpoint.tensors().map(|(_, tensor)| tensor.name.as_str());
    let class = library.find(config, names, Loader::of_config(config))?;
    let tensors = class.expect(config).ok()?.tensors.into_iter();
    let pair = |(name, tensor): (String, ExpectedTensor)| Some([name, tensor.tied_to?]);
    Some(tensors.filter_map(pair).flatten().collect())
}
