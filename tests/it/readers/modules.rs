//! Python modules.

use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{FaultKind, PythonModule};

use super::{Case, hold};

const SOURCE: &str = r#"
from typing import TYPE_CHECKING
import torch.nn as nn, numpy
from transformers import (
    PreTrainedModel,
    LlamaForCausalLM as Llama,
)
from .configuration_x import XConfig, YConfig as Y
from . import action_tokenizer
from ..up import z
from .star import *

try:
    import flash_attn
    from .maybe import m
except ImportError:
    pass
if TYPE_CHECKING:
    import only_for_types
if is_flash_attn_2_available():
    from flash_attn_2 import f
if True:
    import always

def helper():
    import lazily
    class Hidden(nn.Module): pass

@decorator
class XModel(PreTrainedModel, nn.Module, metaclass=Meta):
    tokenizer_class = ("LlamaTokenizer", "LlamaTokenizerFast")
    class Inner(Llama): ...
    def f(self):
        return "class Fake: pass"

class XProcessor(ProcessorMixin):
    attributes = ["tokenizer"]
    tokenizer_class = "AutoTokenizer"

class Computed(ProcessorMixin):
    tokenizer_class = names()

Alias = XModel
a, b = 1, 2
"#;

pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(cases);

fn cases() -> Vec<Case> {
    let case = |label, expected: &[FaultKind], bytes: &[u8]| {
        Case::new(label, expected, PythonModule::parse("m.py", bytes).faults)
    };
    let nested = "(".repeat(100_000);
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 9\n";
    // More syntax nodes than the limit, within the size limit.
    let endless = "a;".repeat(400_000);
    vec![
        case("plain", &[], SOURCE.as_bytes()),
        case("empty", &[], b""),
        case("broken", &[FaultKind::PythonSyntax], b"class A(:\n    pass\n"),
        case("keyword in a dotted name", &[FaultKind::PythonSyntax], b"from a.import.b import x\n"),
        case("keyword of newer versions", &[FaultKind::PythonSyntax], b"async = 1\n"),
        case("keyword as an attribute", &[FaultKind::PythonSyntax], b"x = a.None\n"),
        case("broken import", &[FaultKind::PythonSyntax], b"from a import (b c)\n"),
        case("broken call", &[FaultKind::PythonSyntax], b"f(a b)\n"),
        case("soft keywords", &[], b"import match.type\ncase = match.case\n"),
        case("Latin-1", &[FaultKind::InvalidUtf8], b"# caf\xe9\n"),
        case("pointer", &[FaultKind::LfsPointer], pointer),
        case("nested", &[FaultKind::PythonSyntax], nested.as_bytes()),
        case("endless", &[FaultKind::PythonTooComplex], endless.as_bytes()),
    ]
}

#[test]
fn faults_of_modules() {
    hold(&CASES);
}

#[test]
fn classes_with_bases_and_tokenizer_class() {
    let module = PythonModule::parse("m.py", SOURCE.as_bytes());
    let names: Vec<_> = module.classes.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["XModel", "Inner", "XProcessor", "Computed"]);
    let model = module.class("XModel").unwrap();
    assert_eq!(model.bases, ["PreTrainedModel", "nn.Module"]);
    assert_eq!(&SOURCE[model.name_span.clone()], "XModel");
    assert_eq!(model.tokenizer_class.as_deref().unwrap(), ["LlamaTokenizer", "LlamaTokenizerFast"]);
    assert_eq!(module.class("XProcessor").unwrap().tokenizer_class.as_deref().unwrap(), ["AutoTokenizer"]);
    assert_eq!(module.class("Computed").unwrap().tokenizer_class, None);
}

#[test]
fn imports_relative_and_absolute() {
    let module = PythonModule::parse("m.py", SOURCE.as_bytes());
    let relative: Vec<_> =
        module.relative_imports.iter().map(|i| (i.level, i.module.as_str(), i.names.join(","), i.guarded)).collect();
    let name = str::to_owned;
    assert_eq!(
        relative,
        [
            (1, "configuration_x", name("XConfig,YConfig"), false),
            (1, "action_tokenizer", name(""), false),
            (2, "up", name("z"), false),
            (1, "star", name("*"), false),
            (1, "maybe", name("m"), true),
        ]
    );
    let required: Vec<_> = module.required_packages().map(|i| i.package.as_str()).collect();
    assert_eq!(required, ["typing", "torch", "numpy", "transformers", "always"]);
    assert!(module.imports.iter().any(|i| i.package == "lazily" && i.nested));
}

#[test]
fn names_a_module_defines() {
    let module = PythonModule::parse("m.py", SOURCE.as_bytes());
    for name in ["XModel", "Alias", "a", "b", "Llama", "Y", "nn", "helper", "action_tokenizer"] {
        assert_eq!(module.defines(name), Some(true), "{name}");
    }
    // A star import may bind any name; without one, a missing name is undefined.
    assert_eq!(module.defines("Fake"), None);
    let module = PythonModule::parse("m.py", b"class A: pass\n");
    assert_eq!(module.defines("Fake"), Some(false));
}
