//! The commands on the pages of the documentation, read by the command line's own reader.

use std::ffi::OsString;

use clap::error::ErrorKind;
use kit::pages;

use super::commands;
use super::words::ordered;

/// Every call of this tool on every page is parsed by the command line's own reader.
#[test]
fn what_the_pages_show_is_understood() {
    let mut count = 0;
    for shown in pages::commands() {
        let Some(words) = pages::call_of(&shown.words, "coflash") else { continue };
        // A placeholder is replaced by a value.
        let of = |word: &String| if word == "BOARD" { "stm32f407g-disc1" } else { word }.to_string();
        let words = std::iter::once("coflash".to_string()).chain(words.iter().map(of));
        let words: Vec<String> = words.filter(|word| word != "COMMAND").collect();
        count += 1;
        let words = ordered(words.iter().map(OsString::from).collect(), &commands());
        let Err(error) = commands().try_get_matches_from(&words) else { continue };
        let mention = shown.inline
            && (matches!(
                error.kind(),
                ErrorKind::MissingRequiredArgument
                    | ErrorKind::MissingSubcommand
                    | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
            ) || error.kind() == ErrorKind::InvalidValue
                && error.to_string().contains("a value is required"));
        let help = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
        assert!(mention || help, "{}: {words:?}: {error}", shown.place);
    }
    assert!(count > 60, "{count}");
}
