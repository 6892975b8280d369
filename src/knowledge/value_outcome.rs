//! The letters of the tables that have been derived by trying values: `rules/tokenizer-values.json`,
//! `rules/tokenizer-settings.json` and `rules/preprocessors.json`.

/// What becomes of a value, or of a key that is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ValueOutcome {
    /// It loads.
    Accepted,
    /// The value, or others beside it, decide.
    Depends,
    /// It is refused.
    Refused,
}

impl From<u8> for ValueOutcome {
    /// The letter of a table.
    fn from(letter: u8) -> Self {
        match letter {
            b'R' => Self::Refused,
            b'd' => Self::Depends,
            _ => Self::Accepted,
        }
    }
}
