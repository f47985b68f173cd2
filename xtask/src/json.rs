//! A JSON reader with the parts that `cargo metadata` needs.

use std::collections::BTreeMap;
use std::iter::Peekable;
use std::str::Chars;

use crate::Outcome;

/// A JSON value.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// `null`
    Null,
    /// `true`, `false`
    Bool(bool),
    /// A number, as text.
    Number(String),
    /// A string without escapes.
    String(String),
    /// `[…]`
    Array(Vec<Value>),
    /// `{…}`
    Object(BTreeMap<String, Value>),
}

/// Text as a JSON string.
pub fn quoted(text: &str) -> String {
    let mut string = String::from("\"");
    for letter in text.chars() {
        match letter {
            '"' | '\\' => string.extend(['\\', letter]),
            letter if letter.is_control() => string += &format!("\\u{:04x}", u32::from(letter)),
            letter => string.push(letter),
        }
    }
    string + "\""
}

/// The greatest permitted depth of nesting. It is deeper than in any file of cargo's, and keeps
/// hostile text from exhausting the stack.
const MAX_DEPTH: usize = 64;

impl Value {
    /// Reads exactly one value.
    ///
    /// # Errors
    /// When the text is not JSON.
    pub fn parse(text: &str) -> Outcome<Self> {
        let mut reader = Reader { chars: text.chars().peekable() };
        let value = reader.value(0)?;
        match reader.next_solid() {
            None => Ok(value),
            Some(letter) => Err(format!("JSON: \"{letter}\" behind the end.")),
        }
    }

    /// The member of an object; `Null` if it is missing.
    pub fn get(&self, key: &str) -> &Self {
        match self {
            Self::Object(members) => members.get(key).unwrap_or(&Self::Null),
            _ => &Self::Null,
        }
    }

    /// The elements of an array; none for any other value.
    pub fn items(&self) -> &[Self] {
        match self {
            Self::Array(items) => items,
            _ => &[],
        }
    }

    /// The members of an object, in the order of their names; none for any other value.
    pub fn members(&self) -> impl Iterator<Item = (&str, &Self)> {
        let members = match self {
            Self::Object(members) => Some(members),
            _ => None,
        };
        members.into_iter().flatten().map(|(name, value)| (name.as_str(), value))
    }

    /// The value of a number.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Number(text) => text.parse().ok(),
            _ => None,
        }
    }

    /// The text of a string.
    pub fn text(&self) -> Option<&str> {
        match self {
            Self::String(text) => Some(text),
            _ => None,
        }
    }
}

struct Reader<'a> {
    chars: Peekable<Chars<'a>>,
}

impl Reader<'_> {
    fn peek_solid(&mut self) -> Option<char> {
        while self.chars.next_if(|letter| letter.is_ascii_whitespace()).is_some() {}
        self.chars.peek().copied()
    }

    fn next_solid(&mut self) -> Option<char> {
        self.peek_solid();
        self.chars.next()
    }

    fn value(&mut self, depth: usize) -> Outcome<Value> {
        if depth > MAX_DEPTH {
            return Err("JSON: nested too deeply.".into());
        }
        match self.next_solid() {
            Some('{') => self.object(depth),
            Some('[') => self.array(depth),
            Some('"') => self.string().map(Value::String),
            Some(first) if first == '-' || first.is_ascii_alphanumeric() => {
                let mut word = String::from(first);
                while let Some(next) =
                    self.chars.next_if(|next| next.is_ascii_alphanumeric() || "+-.".contains(*next))
                {
                    word.push(next);
                }
                match word.as_str() {
                    "null" => Ok(Value::Null),
                    "true" => Ok(Value::Bool(true)),
                    "false" => Ok(Value::Bool(false)),
                    _ if word.parse::<f64>().is_ok() => Ok(Value::Number(word)),
                    _ => Err(format!("JSON: \"{word}\" is no value.")),
                }
            }
            Some(letter) => Err(format!("JSON: \"{letter}\" where a value should start.")),
            None => Err("JSON: the text ends where a value should start.".into()),
        }
    }

    fn object(&mut self, depth: usize) -> Outcome<Value> {
        let mut members = BTreeMap::new();
        if self.peek_solid() == Some('}') {
            self.chars.next();
            return Ok(Value::Object(members));
        }
        loop {
            if self.next_solid() != Some('"') {
                return Err("JSON: a member without a name.".into());
            }
            let key = self.string()?;
            if self.next_solid() != Some(':') {
                return Err(format!("JSON: no colon behind \"{key}\"."));
            }
            members.insert(key, self.value(depth + 1)?);
            match self.next_solid() {
                Some(',') => {}
                Some('}') => return Ok(Value::Object(members)),
                _ => return Err("JSON: an object that does not end.".into()),
            }
        }
    }

    fn array(&mut self, depth: usize) -> Outcome<Value> {
        let mut items = Vec::new();
        if self.peek_solid() == Some(']') {
            self.chars.next();
            return Ok(Value::Array(items));
        }
        loop {
            items.push(self.value(depth + 1)?);
            match self.next_solid() {
                Some(',') => {}
                Some(']') => return Ok(Value::Array(items)),
                _ => return Err("JSON: an array that does not end.".into()),
            }
        }
    }

    fn string(&mut self) -> Outcome<String> {
        let mut text = String::new();
        loop {
            match self.chars.next() {
                Some('"') => return Ok(text),
                Some('\\') => text.push(self.escape()?),
                Some(letter) => text.push(letter),
                None => return Err("JSON: a string that does not end.".into()),
            }
        }
    }

    fn escape(&mut self) -> Outcome<char> {
        match self.chars.next() {
            Some('n') => Ok('\n'),
            Some('t') => Ok('\t'),
            Some('r') => Ok('\r'),
            Some('b') => Ok('\u{8}'),
            Some('f') => Ok('\u{C}'),
            Some(letter @ ('"' | '\\' | '/')) => Ok(letter),
            Some('u') => {
                let digits: String = self.chars.by_ref().take(4).collect();
                let code = u32::from_str_radix(&digits, 16).ok().filter(|_| digits.len() == 4);
                // Cargo's output about a workspace contains no surrogate pairs.
                Ok(code.and_then(char::from_u32).unwrap_or(char::REPLACEMENT_CHARACTER))
            }
            _ => Err("JSON: an unknown escape.".into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_json_is_read() {
        let value =
            Value::parse(r#" {"a": [1, -2.5e3, "x\n\"\u00e9\/"], "b": {}, "c": [ ], "d": null, "e": true} "#)
                .unwrap();
        assert_eq!(value.get("a").items()[1], Value::Number("-2.5e3".into()));
        assert_eq!(value.get("a").items()[2].text(), Some("x\n\"é/"));
        assert_eq!(value.get("b"), &Value::Object(BTreeMap::new()));
        assert_eq!(value.get("c").items(), []);
        assert_eq!(value.get("d"), &Value::Null);
        assert_eq!(value.get("e"), &Value::Bool(true));
        assert_eq!(value.get("nothing").get("at").get("all").text(), None);
    }

    #[test]
    fn text_is_quoted_so_that_it_is_read_again() {
        for text in ["", "a \"b\" \\ é", "\n\t\u{1}"] {
            assert_eq!(Value::parse(&quoted(text)).unwrap().text(), Some(text));
        }
    }

    #[test]
    fn what_is_not_is_refused() {
        for text in
            ["", "{", "[1", "[1 2]", "{\"a\"}", "{a:1}", "\"abc", "nul", "[]]", "\"\\x\"", "{\"a\":}", "-"]
        {
            assert!(Value::parse(text).is_err(), "{text}");
        }
        assert!(Value::parse(&"[".repeat(100_000)).is_err());
    }
}
