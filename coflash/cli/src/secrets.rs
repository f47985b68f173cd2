//! Removes passwords from a command line, for records that users pass on.

use std::ffi::OsString;

use coboot_can::redact::is_password;

use super::values::address;

/// The options with a secret value.
const SECRET: [&str; 3] = ["--unlock", "--key", "--of-value"];

/// The replacement for a password.
const HIDDEN: &str = "***";

/// The words with the secrets hidden: the values of `--unlock`, `--key` and `--of-value`, and the
/// value that `write` writes into an object for a password.
pub(super) fn without(words: &[OsString]) -> Vec<String> {
    let mut hide = false;
    let writes = words.iter().any(|word| word == "write");
    let shown = |word: &OsString| {
        let word = word.to_string_lossy().into_owned();
        if std::mem::take(&mut hide) {
            return HIDDEN.to_string();
        }
        if let Some(option) = SECRET.iter().find(|option| word.starts_with(&format!("{option}="))) {
            return format!("{option}={HIDDEN}");
        }
        let into_password = writes && address(&word).is_some_and(is_password);
        hide = SECRET.contains(&word.as_str()) || into_password;
        word
    };
    words.iter().map(shown).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_are_hidden() {
        for (words, shown) in [
            ("coflash flash a --unlock sesame -N 5", "coflash flash a --unlock *** -N 5"),
            ("coflash flash a --unlock=sesame", "coflash flash a --unlock=***"),
            ("coflash convert a --key 1234 --add 1", "coflash convert a --key *** --add 1"),
            ("coflash key new --role kek --of-value 12", "coflash key new --role kek --of-value ***"),
            ("coflash write 6005/1 sesame --type string", "coflash write 6005/1 *** --type string"),
            ("coflash write 0x7F50/1 0x494E4954", "coflash write 0x7F50/1 ***"),
            ("coflash read 6005/1 100A", "coflash read 6005/1 100A"),
            ("coflash flash a --unlock", "coflash flash a --unlock"),
        ] {
            let words: Vec<OsString> = words.split(' ').map(OsString::from).collect();
            assert_eq!(without(&words).join(" "), shown);
        }
    }
}
