//! The texts of the service station in each language: one table, which the page reads as well.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;

use super::message::Message;

/// The table. A text has names in braces where a value is filled in.
pub(super) const TABLE: &str = include_str!("page/words.json");

/// A language of the page and of the reports.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Language {
    /// English.
    #[default]
    En,
    /// German.
    De,
}

/// A text in each language.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Text {
    en: String,
    de: String,
}

/// The tests read the table, so it has its form.
static TEXTS: LazyLock<BTreeMap<String, Text>> =
    LazyLock::new(|| serde_json::from_str(TABLE).unwrap_or_default());

impl Language {
    /// Its code (ISO 639-1).
    pub(super) const fn code(self) -> &'static str {
        match self {
            Self::En => "en",
            Self::De => "de",
        }
    }

    /// The text with this key.
    pub(super) fn text(self, key: &'static str) -> &'static str {
        TEXTS.get(key).map_or(key, |text| match self {
            Self::En => &text.en,
            Self::De => &text.de,
        })
    }

    /// A message in this language.
    pub(super) fn message(self, message: &Message) -> String {
        filled(self.text(message.key), |name| message.values.get(name).cloned().unwrap_or_default())
    }
}

/// A text with a value for each name in braces. What is filled in may have braces, and is not filled in again.
pub(super) fn filled(text: &'static str, value: impl Fn(&'static str) -> String) -> String {
    let mut parts = text.split('{');
    let first = parts.next().unwrap_or_default().to_owned();
    let parts = parts.filter_map(|part| part.split_once('}'));
    parts.fold(first, |all, (name, rest)| all + &value(name) + rest)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::super::sheet::PAGE as SHEET;
    use super::*;

    const PAGE: &str = include_str!("page/service.html");
    const SCRIPT: &str = include_str!("page/service.js");
    /// The modules that name texts: by literals of small letters with a dash, or of one word.
    const MODULES: [&str; 9] = [
        include_str!("../adapters.rs"),
        include_str!("report.rs"),
        include_str!("requests.rs"),
        include_str!("row.rs"),
        include_str!("setup.rs"),
        include_str!("sheet.rs"),
        include_str!("station.rs"),
        include_str!("trouble.rs"),
        include_str!("work.rs"),
    ];

    /// The names in braces of a text.
    fn names(text: &str) -> BTreeSet<&str> {
        text.split('{').skip(1).map(|rest| rest.split('}').next().unwrap()).collect()
    }

    /// The keys that follow these words in a source.
    fn after<'a>(source: &'a str, words: &str) -> Vec<&'a str> {
        source.split(words).skip(1).map(|rest| rest.split('"').next().unwrap()).collect()
    }

    /// Each text is there in each language and takes the same values.
    #[test]
    fn both_languages_have_each_text() {
        assert!(serde_json::from_str::<BTreeMap<String, Text>>(TABLE).is_ok_and(|table| !table.is_empty()));
        for (key, Text { en, de }) in &*TEXTS {
            assert!(!en.trim().is_empty() && !de.trim().is_empty(), "{key}");
            assert_eq!(names(en), names(de), "{key}");
        }
        // A key that is there twice would hide a text.
        let lines: Vec<&str> = TABLE.lines().filter_map(|line| line.trim().strip_prefix('"')).collect();
        assert_eq!(lines.len(), TEXTS.len(), "one text a line, and no key twice");
    }

    /// A program may have the name of another value.
    #[test]
    fn what_is_filled_in_is_not_filled_in_again() {
        let message = Message::new("trouble-too-few")
            .value("program", "{found}")
            .value("expected", 2)
            .value("found", 0);
        let said = Language::En.message(&message);
        assert!(said.starts_with("{found}: 2 devices are expected, and 0 found."), "{said}");
    }

    /// A station works with a package or with a job file: one text names the package, and the others suit both.
    #[test]
    fn a_station_with_a_job_file_speaks_of_no_package() {
        let speaks = |text: &Text| text.en.to_lowercase().contains("package") || text.de.contains("Paket");
        let keys: Vec<&str> =
            TEXTS.iter().filter(|(_, text)| speaks(text)).map(|(key, _)| key.as_str()).collect();
        assert_eq!(keys, ["package", "verified-package"]);
    }

    /// Each key of the page and of the server is in the table, and the table has no other one.
    #[test]
    fn each_key_is_in_the_table_and_each_text_is_used() {
        let mut used: BTreeSet<&str> = BTreeSet::new();
        for attribute in ["data-t=\"", "data-t-label=\"", "data-t-placeholder=\""] {
            used.extend(after(PAGE, attribute));
        }
        used.extend(after(SCRIPT, " t(\"").into_iter().chain(after(SCRIPT, "(t(\"")));
        used.extend(names(SHEET).into_iter().filter(|name| !name.starts_with('=')));
        let known: BTreeSet<&str> = TEXTS.keys().map(String::as_str).collect();
        let is_key = |word: &str| {
            let is_letters = |part: &str| !part.is_empty() && part.bytes().all(|c| c.is_ascii_lowercase());
            word.contains('-') && word.split('-').all(is_letters)
        };
        let literals = MODULES.iter().flat_map(|module| module.split('"'));
        used.extend(literals.filter(|word| known.contains(word) || is_key(word)));
        assert_eq!(used.difference(&known).collect::<Vec<_>>(), Vec::<&&str>::new(), "not in the table");
        assert_eq!(known.difference(&used).collect::<Vec<_>>(), Vec::<&&str>::new(), "not used");
    }
}
