//! Advice in the words of the engineer's page, which names its own buttons and fields.

use std::fmt::Display;

use coflash_core::advice::{Advice, Front};
use coflash_core::file::FileError;

/// What to do next.
pub(super) fn on_page(advice: &Advice) -> String {
    advice.words(Front::Page)
}

/// A text of the library that has this advice in it, in the words of the page.
pub(super) fn with_advice(text: impl Display, advice: impl IntoIterator<Item = Advice>) -> String {
    let word = |text: String, advice: Advice| text.replace(&advice.to_string(), &on_page(&advice));
    advice.into_iter().fold(text.to_string(), word)
}

/// The fault of a file.
pub(super) fn of_file(error: &FileError) -> String {
    with_advice(error, error.error.cause.advice())
}

#[cfg(test)]
mod tests {
    use coflash_core::advice::OfProgram;

    use super::*;

    #[test]
    fn a_text_with_advice_gets_the_words_of_the_page() {
        let start = |number| Advice::StartIt { program: OfProgram(number) };
        let words = with_advice(format!("it waits: {}", start(1)), Some(start(1)));
        assert_eq!(words, "it waits: Start the program, in More … at the device, starts it again");
        let second = with_advice(start(2), Some(start(2)));
        assert!(second.starts_with("Start the program with 2 in the field Program, in More"), "{second}");
        assert_eq!(start(2).to_string(), "coflash start --program 2 starts it again");
        assert_eq!(with_advice("it waits", None), "it waits");
    }
}
