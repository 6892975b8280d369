//! Reads the test data: configs, condensed tensor maps, and records of transformers 4.47.0 on small models.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Deserialize;
use serde_json::Value;

/// Tensor name to shape.
pub type Map = BTreeMap<String, Vec<u64>>;

fn read(file: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(file);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// `configs/NAME.json`.
pub fn config(name: &str) -> Value {
    serde_json::from_str(&read(&format!("configs/{name}.json"))).expect("JSON")
}

/// `maps/NAME.txt`: each line has a name and a shape; `{0..25}` in a name expands to each of the numbers.
pub fn map(name: &str) -> Map {
    read(&format!("maps/{name}.txt"))
        .lines()
        .filter(|line| !line.starts_with('#'))
        .flat_map(|line| {
            let (name, shape) = line.split_once(' ').expect("name and shape");
            let shape: Vec<u64> = serde_json::from_str(shape).expect("shape");
            expand(name).into_iter().map(move |name| (name, shape.clone()))
        })
        .collect()
}

fn expand(name: &str) -> Vec<String> {
    let Some((before, rest)) = name.split_once('{') else { return vec![name.to_owned()] };
    let (range, after) = rest.split_once('}').expect("closing brace");
    let (from, to) = range.split_once("..").expect("range");
    let (from, to): (u64, u64) = (from.parse().expect("number"), to.parse().expect("number"));
    (from..=to).flat_map(|i| expand(&format!("{before}{i}{after}"))).collect()
}

/// One model: the state dict that transformers builds from a config, and its load reports for mutated copies of the
/// file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    pub class: String,
    pub config: Value,
    state_dict: BTreeMap<String, Vec<u64>>,
    #[serde(default)]
    pub saved_omits: Vec<String>,
    /// Non-persistent buffers, sorted.
    pub buffers: Option<Vec<String>>,
    #[serde(default)]
    pub tied: Vec<Vec<String>>,
    pub load: Option<Load>,
    #[serde(default)]
    pub mutations: Vec<Mutation>,
}

/// A change of the saved file, and the loader's report for it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mutation {
    pub kind: String,
    #[serde(default)]
    drop: Vec<String>,
    #[serde(default)]
    reshape: Map,
    #[serde(default)]
    rename: BTreeMap<String, String>,
    #[serde(default)]
    add: Map,
    pub load: Load,
}

/// The loader's lists, or its error.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Load {
    #[serde(default)]
    pub missing: Vec<String>,
    #[serde(default)]
    pub unexpected: Vec<String>,
    /// Name, shape in the file, shape in the model.
    #[serde(default)]
    pub mismatched: Vec<(String, Vec<u64>, Vec<u64>)>,
    pub error: Option<String>,
}

impl Record {
    pub fn state_dict(&self) -> Map {
        self.state_dict.iter().flat_map(|(name, shape)| expand(name).into_iter().map(|n| (n, shape.clone()))).collect()
    }

    /// The tensors that `save_pretrained` writes.
    pub fn saved(&self) -> Map {
        let mut saved = self.state_dict();
        saved.retain(|name, _| !self.saved_omits.contains(name));
        saved
    }
}

impl Mutation {
    pub fn apply(&self, saved: &Map) -> Map {
        let mut out = Map::new();
        for (name, shape) in saved {
            if !self.drop.contains(name) {
                let shape = self.reshape.get(name).unwrap_or(shape);
                out.insert(self.rename.get(name).unwrap_or(name).clone(), shape.clone());
            }
        }
        out.extend(self.add.clone());
        out
    }
}

/// `loader/NAME.jsonl`.
pub fn records(name: &str) -> Vec<Record> {
    read(&format!("loader/{name}.jsonl")).lines().map(|line| serde_json::from_str(line).expect("a record")).collect()
}
