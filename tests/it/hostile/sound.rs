//! Rows C14, C15 and F13: unusual but valid.

use ckpt_doctor::checkpoint::Dtype;

use super::place::{SHARD, entry, file, header};
use super::{Case, case, clean, paths};

pub fn cases() -> Vec<Case> {
    let tensors = |name: &str, entries: String, data| clean("C14", name, move |d| d.tensors(&entries, data));
    let raw = |name: &str, bytes: Vec<u8>| clean("C14", name, move |d| d.shard(&bytes));
    let one = header(&entry("a", "U8", "[1]", 0, 1));
    let bytes = |name: &str, begin, end: u64| entry(name, "U8", &format!("[{}]", end - begin), begin, end);
    let mut cases = vec![
        tensors("no elements", entry("a", "F32", "[0]", 0, 0), 0),
        tensors("no elements in many dimensions", entry("a", "F32", "[3,0,5]", 0, 0), 0),
        tensors("a scalar", entry("a", "F32", "[]", 0, 4), 4),
        tensors(
            "two of no elements at one place",
            [entry("a", "F32", "[0]", 0, 0), entry("b", "F32", "[0]", 0, 0)].join(","),
            0,
        ),
        tensors("four-bit elements", entry("a", "F4", "[2,3]", 0, 3), 3),
        tensors("six-bit elements", entry("a", "F6_E2M3", "[4]", 0, 3), 3),
        tensors("any order", [bytes("z", 4, 8), bytes("m", 0, 4), bytes("a", 8, 9)].join(","), 9),
        tensors("unaligned tensors", [bytes("a", 0, 1), entry("b", "F64", "[1]", 1, 9)].join(","), 9),
        tensors(
            "names in every script",
            [bytes("模型.权重", 0, 1), bytes("é🤗", 1, 2), bytes("слой.0", 2, 3)].join(","),
            3,
        ),
        tensors("names with spaces", bytes("a b", 0, 1), 1),
        tensors("a long name", bytes(&"layer.".repeat(100), 0, 1), 1),
        tensors("eight dimensions", entry("a", "U8", "[1,1,1,1,1,1,1,1]", 0, 1), 1),
        tensors("escapes in a name", bytes(r"\u006d\u006fdel", 0, 1), 1),
        tensors(
            "unknown keys",
            r#""a":{"dtype":"U8","shape":[1],"data_offsets":[0,1],"x":{"y":[1.5,null]}}"#.to_owned(),
            1,
        ),
        tensors("fields in another order", r#""a":{"data_offsets":[0,1],"shape":[1],"dtype":"U8"}"#.to_owned(), 1),
        raw("leading white space", file(format!(" \n\t{one}"), 1)),
        raw("white space everywhere", file(one.replace(',', " ,\r\n ").replace(':', " : "), 1)),
        raw("unaligned header", file(format!("{one} "), 1)),
        raw("twenty megabytes of padding", file(format!("{one}{}", " ".repeat(20_000_000)), 1)),
        raw(
            "much metadata",
            file(
                format!(r#"{{"__metadata__":{{"format":"pt","x":"{}"}},{}}}"#, "y".repeat(1 << 20), bytes("a", 0, 1)),
                1,
            ),
        ),
        clean("C14", "hub cache", paths::hub_cache),
        clean("C15", "NaN among the weights", |d| {
            let mut bytes = file(header(&entry("a", "F32", "[2]", 0, 8)), 0);
            bytes.extend(f32::NAN.to_le_bytes());
            bytes.extend(f32::INFINITY.to_le_bytes());
            d.shard(bytes);
        }),
        clean("F13", "a whole Llama", super::place::Dir::llama),
        clean("F13", "neighbours", |d| {
            d.llama();
            for name in ["README.md", "LICENSE", ".gitattributes", "model.onnx", "events.out", "trainer_state.txt"] {
                d.put(name, "not JSON");
            }
            d.folder("onnx");
            d.folder("checkpoint-500");
        }),
        clean("F13", "an adapter alone", |d| {
            let config = r#"{"peft_type": "LORA", "base_model_name_or_path": "org/llama", "r": 4, "target_modules": ["q_proj"]}"#;
            d.put("adapter_config.json", config);
            let module = "base_model.model.model.layers.0.self_attn.q_proj";
            let entries = [
                entry(&format!("{module}.lora_A.weight"), "F32", "[4,8]", 0, 128),
                entry(&format!("{module}.lora_B.weight"), "F32", "[8,4]", 128, 256),
            ];
            d.put("adapter_model.safetensors", file(header(&entries.join(",")), 256));
        }),
        case("F13", "no weights", "FIL007", "", |d| {
            d.small();
            d.remove(SHARD);
        }),
    ];
    for dtype in Dtype::ALL {
        let (name, size) = (dtype.name(), dtype.bits());
        cases.push(clean("C14", format!("type {name}"), move |d| {
            d.tensors(&entry("a", name, "[8]", 0, size), usize::try_from(size).unwrap());
        }));
    }
    cases
}
