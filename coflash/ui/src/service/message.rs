//! A message for people: a key of the table of texts, and what is filled in. The page has the language.

use std::collections::BTreeMap;

use serde::Serialize;

/// A message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Message {
    /// The key in the table.
    pub(super) key: &'static str,
    /// The values for the names in braces.
    pub(super) values: BTreeMap<&'static str, String>,
    /// What the library says, in English: for a report, and for whoever helps.
    pub(super) detail: Option<String>,
    /// The stable error number.
    pub(super) number: Option<u32>,
}

impl Message {
    pub(super) fn new(key: &'static str) -> Self {
        Self { key, values: BTreeMap::new(), detail: None, number: None }
    }

    pub(super) fn value(mut self, name: &'static str, value: impl ToString) -> Self {
        self.values.insert(name, value.to_string());
        self
    }

    pub(super) fn detail(mut self, words: impl ToString) -> Self {
        self.detail = Some(words.to_string());
        self
    }

    pub(super) fn number(mut self, number: u32) -> Self {
        self.number = Some(number);
        self
    }

    /// The error number and what the library says, in one line.
    pub(super) fn original(&self) -> String {
        let number = self.number.map(|number| format!("[0x{number:08X}]"));
        let parts: Vec<&str> = [self.detail.as_deref(), number.as_deref()].into_iter().flatten().collect();
        parts.join(" ")
    }
}
