//! The configuration file: defaults for options, so that they need not be typed.

use std::fmt;

use super::toml_line::line_of;

/// The options that a file may give defaults for.
pub const KEYS: [&str; 8] =
    ["bus", "node", "board", "block-size", "sdo-timeout", "command-timeout", "boot-timeout", "block-repeats"];

/// What is wrong with a configuration file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It is no TOML, in this line.
    Line(usize, String),
    /// It says what it may not say.
    Setting(String),
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(line, what) => write!(f, "line {line}: {what}"),
            Self::Setting(what) => f.write_str(what),
        }
    }
}

impl std::error::Error for Fault {}

/// Takes a configuration file apart: options, each one of [`KEYS`], with their values as the
/// command line would have them.
///
/// # Errors
/// The first thing that is wrong with it.
pub fn parse(text: &str) -> Result<Vec<(String, String)>, Fault> {
    let table: toml::Table = text
        .parse()
        .map_err(|error: toml::de::Error| Fault::Line(line_of(text, &error), error.message().to_string()))?;
    let setting = |(key, value): (String, toml::Value)| {
        if !KEYS.contains(&key.as_str()) {
            return Err(Fault::Setting(format!("there is no setting '{key}'")));
        }
        match value {
            toml::Value::String(text) => Ok((key, text)),
            toml::Value::Integer(number) => Ok((key, number.to_string())),
            other => Err(Fault::Setting(format!(
                "'{key}' must be a number or a text, and is {}",
                other.type_str()
            ))),
        }
    };
    table.into_iter().map(setting).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documentations_example_is_all_that_a_file_may_have() {
        let page = include_str!("../../../docs/coflash.md");
        let example = page.split("```toml\n").nth(1).and_then(|block| block.split("```").next()).unwrap();
        let settings = parse(example).unwrap();
        let mut keys: Vec<&str> = settings.iter().map(|(key, _)| key.as_str()).collect();
        let mut known = KEYS.to_vec();
        keys.sort_unstable();
        known.sort_unstable();
        assert_eq!(keys, known);
    }

    #[test]
    fn a_fault_is_named_with_its_place() {
        assert_eq!(
            parse("node = '5'\nsdo-timeout = 70").unwrap(),
            [("node".to_string(), "5".to_string()), ("sdo-timeout".to_string(), "70".to_string())]
        );
        for (text, words) in [
            ("node = 5\n\nnode = 6\n", "line 3: "),
            ("node = \n", "line 1: "),
            ("speed = 5\n", "there is no setting 'speed'"),
            ("node = [5]\n", "'node' must be a number or a text, and is array"),
            ("[node]\n", "'node' must be a number or a text, and is table"),
        ] {
            let fault = parse(text).unwrap_err().to_string();
            assert!(fault.contains(words), "{text:?}: {fault}");
        }
    }
}
