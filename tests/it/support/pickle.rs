//! Writes pickles as `torch.save` does, and broken ones.

#![allow(dead_code, reason = "the fuzz target needs a part")]
#![allow(
    clippy::arithmetic_side_effects,
    clippy::expect_used,
    clippy::indexing_slicing,
    clippy::panic,
    reason = "a panic is the finding"
)]

use std::collections::BTreeMap;

/// The pickles before the state dict in a file of the old format.
pub const LEGACY_HEAD: &[u8] =
    b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19\x2e\x80\x02M\xe9\x03.\x80\x02}.";

/// A tensor: a view of a storage.
#[derive(Clone)]
pub struct PickledTensor {
    pub name: String,
    /// Number of the storage.
    pub storage: usize,
    /// Offset, shape and strides in elements.
    pub offset: u64,
    pub shape: Vec<u64>,
    pub strides: Vec<u64>,
}

/// A storage: the class, such as `FloatStorage`, the width of an element, and the bytes.
#[derive(Clone)]
pub struct PickledStorage {
    pub class: String,
    pub width: u64,
    pub bytes: Vec<u8>,
}

/// A state dict to be pickled.
#[derive(Clone, Default)]
pub struct StateDict {
    pub storages: Vec<PickledStorage>,
    pub tensors: Vec<PickledTensor>,
    /// The key under which the tensors are; at the top without one.
    pub under: Option<String>,
    /// A function of a module that is called without arguments for the value of one more key.
    pub calls: Option<(String, String)>,
    /// Whether each tensor is a parameter.
    pub parameters: bool,
    /// Keys of storages that the archive lacks, and those whose last eight bytes it lacks.
    pub lost: Vec<usize>,
    pub shortened: Vec<usize>,
}

/// The storage class and width for a dtype of safetensors.
pub fn storage_class(dtype: &str) -> (&'static str, u64) {
    match dtype {
        "F64" => ("DoubleStorage", 8),
        "F32" => ("FloatStorage", 4),
        "F16" => ("HalfStorage", 2),
        "BF16" => ("BFloat16Storage", 2),
        "I64" => ("LongStorage", 8),
        "I32" => ("IntStorage", 4),
        "I8" => ("CharStorage", 1),
        "U8" => ("ByteStorage", 1),
        "BOOL" => ("BoolStorage", 1),
        other => panic!("no storage for {other}"),
    }
}

/// Strides of a tensor in row-major order.
pub fn row_major(shape: &[u64]) -> Vec<u64> {
    let mut strides: Vec<u64> = shape.iter().rev().scan(1, |n, size| Some(std::mem::replace(n, *n * size))).collect();
    strides.reverse();
    strides
}

/// Opcodes of a pickle of protocol 2.
#[derive(Default)]
pub struct Pickler {
    pub bytes: Vec<u8>,
}

impl Pickler {
    pub fn new() -> Self {
        Self { bytes: vec![0x80, 2] }
    }

    pub fn op(&mut self, op: u8) -> &mut Self {
        self.bytes.push(op);
        self
    }

    pub fn text(&mut self, text: &str) -> &mut Self {
        self.bytes.push(b'X');
        self.bytes.extend(u32::try_from(text.len()).expect("short").to_le_bytes());
        self.bytes.extend(text.as_bytes());
        self
    }

    pub fn int(&mut self, n: u64) -> &mut Self {
        if let Ok(n) = i32::try_from(n) {
            self.bytes.push(b'J');
            self.bytes.extend(n.to_le_bytes());
        } else {
            self.bytes.extend([0x8a, 8]);
            self.bytes.extend(n.to_le_bytes());
        }
        self
    }

    pub fn import(&mut self, module: &str, name: &str) -> &mut Self {
        self.bytes.extend(format!("c{module}\n{name}\n").as_bytes());
        self
    }

    fn counts(&mut self, counts: &[u64]) {
        self.op(b'(');
        for n in counts {
            self.int(*n);
        }
        self.op(b't');
    }

    pub fn stop(&mut self) -> Vec<u8> {
        self.op(b'.');
        std::mem::take(&mut self.bytes)
    }
}

impl StateDict {
    /// Adds a tensor with a storage of its own.
    pub fn add(&mut self, name: &str, dtype: &str, shape: &[u64], bytes: Vec<u8>) {
        let (class, width) = storage_class(dtype);
        let (strides, storage) = (row_major(shape), self.storages.len());
        self.storages.push(PickledStorage { class: class.to_owned(), width, bytes });
        self.tensors.push(PickledTensor { name: name.to_owned(), storage, offset: 0, shape: shape.to_vec(), strides });
    }

    /// The pickle of the dict.
    pub fn pickle(&self, legacy: bool) -> Vec<u8> {
        let mut out = Pickler::new();
        if let Some(key) = &self.under {
            out.op(b'}').op(b'(').text("epoch").int(3).text(key);
        }
        out.import("collections", "OrderedDict").op(b')').op(b'R').op(b'(');
        for tensor in &self.tensors {
            out.text(&tensor.name);
            self.tensor(&mut out, tensor, legacy);
        }
        if let Some((module, name)) = &self.calls {
            out.text("extra").import(module, name).op(b')').op(b'R');
        }
        out.op(b'u').op(b'}').text("_metadata").op(b'}').op(b's').op(b'b');
        if self.under.is_some() {
            out.op(b'u');
        }
        out.stop()
    }

    fn tensor(&self, out: &mut Pickler, tensor: &PickledTensor, legacy: bool) {
        let storage = &self.storages[tensor.storage];
        if self.parameters {
            out.import("torch._utils", "_rebuild_parameter").op(b'(');
        }
        out.import("torch._utils", "_rebuild_tensor_v2").op(b'(');
        out.op(b'(').text("storage").import("torch", &storage.class).text(&tensor.storage.to_string()).text("cpu");
        out.int(u64::try_from(storage.bytes.len()).expect("small") / storage.width);
        if legacy {
            out.op(b'N');
        }
        out.op(b't').op(b'Q').int(tensor.offset);
        out.counts(&tensor.shape);
        out.counts(&tensor.strides);
        out.op(0x89).import("collections", "OrderedDict").op(b')').op(b'R').op(b't').op(b'R');
        if self.parameters {
            out.op(0x89).import("collections", "OrderedDict").op(b')').op(b'R').op(b't').op(b'R');
        }
    }

    /// The members of the archive.
    pub fn members(&self) -> Vec<(String, Vec<u8>)> {
        let mut members = vec![
            ("archive/data.pkl".to_owned(), self.pickle(false)),
            ("archive/byteorder".to_owned(), b"little".to_vec()),
        ];
        for (key, storage) in self.storages.iter().enumerate().filter(|(key, _)| !self.lost.contains(key)) {
            let cut = if self.shortened.contains(&key) { 8 } else { 0 };
            let bytes = storage.bytes[..storage.bytes.len() - cut].to_vec();
            members.push((format!("archive/data/{key}"), bytes));
        }
        members.push(("archive/version".to_owned(), b"3\n".to_vec()));
        members
    }

    /// The file of `torch.save`.
    pub fn zip(&self) -> Vec<u8> {
        archive(&self.members())
    }

    /// The file of `torch.save` before 1.6.
    pub fn legacy(&self) -> Vec<u8> {
        let mut out = LEGACY_HEAD.to_vec();
        out.extend(self.pickle(true));
        let mut keys = Pickler::new();
        keys.op(b']').op(b'(');
        for key in 0..self.storages.len() {
            keys.text(&key.to_string());
        }
        out.extend(keys.op(b'e').stop());
        for storage in &self.storages {
            let len = u64::try_from(storage.bytes.len()).expect("small");
            out.extend((len / storage.width).to_le_bytes());
            out.extend(&storage.bytes);
        }
        out
    }
}

/// A zip archive of stored members.
pub fn archive(members: &[(String, Vec<u8>)]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    let crcs: BTreeMap<usize, u32> = members.iter().map(|(_, bytes)| crc32(bytes)).enumerate().collect();
    for (number, (name, bytes)) in members.iter().enumerate() {
        let (name_len, len) = (u16::try_from(name.len()).expect("short"), u32::try_from(bytes.len()).expect("small"));
        let at = u32::try_from(out.len()).expect("small");
        let mut fields = vec![0, 0, 0, 0, 0, 0, 0, 0];
        fields.extend(crcs[&number].to_le_bytes());
        fields.extend(len.to_le_bytes());
        fields.extend(len.to_le_bytes());
        fields.extend(name_len.to_le_bytes());
        fields.extend([0, 0]);
        out.extend(b"PK\x03\x04\x14\x00");
        out.extend(&fields);
        out.extend(name.as_bytes());
        out.extend(bytes);
        directory.extend(b"PK\x01\x02\x14\x00\x14\x00");
        directory.extend(&fields);
        directory.extend([0; 10]);
        directory.extend(at.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let start = u32::try_from(out.len()).expect("small");
    let count = u16::try_from(members.len()).expect("few");
    let len = u32::try_from(directory.len()).expect("small");
    out.extend(directory);
    out.extend(b"PK\x05\x06\x00\x00\x00\x00");
    out.extend(count.to_le_bytes());
    out.extend(count.to_le_bytes());
    out.extend(len.to_le_bytes());
    out.extend(start.to_le_bytes());
    out.extend([0, 0]);
    out
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ if crc & 1 == 1 { 0xedb8_8320 } else { 0 })
    })
}
