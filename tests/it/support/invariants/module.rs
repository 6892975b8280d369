//! Python modules.

use std::ops::Range;

use ckpt_doctor::checkpoint::{FaultKind, PythonModule};

/// File name of the module.
pub const NAME: &str = "modeling_x.py";

/// The invariants of a module.
pub fn hold(bytes: &[u8]) {
    let module = PythonModule::parse(NAME, bytes);
    super::faults_are_placed(&module.faults, NAME, module.text.as_deref());
    assert_eq!(
        module.text.is_some(),
        std::str::from_utf8(bytes).is_ok() && !super::has(&module.faults, FaultKind::LfsPointer)
    );
    let Some(text) = &module.text else {
        assert!(module.unread && module.classes.is_empty());
        return;
    };
    assert_eq!(text.as_bytes(), bytes);
    let inside = |span: &Range<usize>| text.get(span.clone()).unwrap_or_else(|| panic!("{span:?} is not in the text"));
    for class in &module.classes {
        assert_eq!(inside(&class.name_span), class.name);
        inside(&class.span);
        assert!(module.class(&class.name).is_some());
        assert!(class.bases.iter().all(|base| text.contains(base)));
    }
    for import in &module.relative_imports {
        inside(&import.span);
        assert!(import.level > 0);
    }
    for import in &module.imports {
        inside(&import.span);
    }
    for name in &module.names {
        assert_eq!(module.defines(name), Some(true));
    }
}
