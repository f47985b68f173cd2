//! The configuration file, which contains defaults for options.

use super::toml_line::line_of;

/// The value of a setting.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Setting {
    /// A number or a text, in the form of the command line.
    Value(String),
    /// An option without a value: whether it is set.
    Switch(bool),
}

/// An error in a configuration file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// The file is not TOML; with the number of the line.
    #[error("line {0}: {1}")]
    Line(usize, String),
    /// A setting is not permitted.
    #[error("{0}")]
    Setting(String),
}

/// Parses a configuration file into options with their values. `is_switch` returns whether an
/// option is a switch without a value, or `None` for an unknown option.
///
/// # Errors
/// The first error in the file.
pub fn parse(text: &str, is_switch: &dyn Fn(&str) -> Option<bool>) -> Result<Vec<(String, Setting)>, Fault> {
    let table: toml::Table = text
        .parse()
        .map_err(|error: toml::de::Error| Fault::Line(line_of(text, &error), error.message().to_string()))?;
    let setting = |(key, value): (String, toml::Value)| {
        let Some(switch) = is_switch(&key) else {
            return Err(Fault::Setting(format!("there is no setting '{key}'")));
        };
        match (value, switch) {
            (toml::Value::String(text), false) => Ok((key, Setting::Value(text))),
            (toml::Value::Integer(number), false) => Ok((key, Setting::Value(number.to_string()))),
            (toml::Value::Boolean(on), true) => Ok((key, Setting::Switch(on))),
            (other, false) => Err(Fault::Setting(format!(
                "'{key}' must be a number or a text, and is {}",
                other.type_str()
            ))),
            (other, true) => {
                Err(Fault::Setting(format!("'{key}' must be true or false, and is {}", other.type_str())))
            }
        }
    };
    table.into_iter().map(setting).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_is_named_with_its_place() {
        let known = |key: &str| match key {
            "node" | "sdo-timeout" => Some(false),
            "verify" => Some(true),
            _ => None,
        };
        let value = |text: &str| Setting::Value(text.to_string());
        assert_eq!(
            parse("node = '5'\nsdo-timeout = 70\nverify = false", &known).unwrap(),
            [
                ("node".to_string(), value("5")),
                ("sdo-timeout".to_string(), value("70")),
                ("verify".to_string(), Setting::Switch(false))
            ]
        );
        for (text, words) in [
            ("node = 5\n\nnode = 6\n", "line 3: "),
            ("node = \n", "line 1: "),
            ("speed = 5\n", "there is no setting 'speed'"),
            ("node = [5]\n", "'node' must be a number or a text, and is array"),
            ("[node]\n", "'node' must be a number or a text, and is table"),
            ("node = true\n", "'node' must be a number or a text, and is boolean"),
            ("verify = 'yes'\n", "'verify' must be true or false, and is string"),
        ] {
            let fault = parse(text, &known).unwrap_err().to_string();
            assert!(fault.contains(words), "{text:?}: {fault}");
        }
    }
}
