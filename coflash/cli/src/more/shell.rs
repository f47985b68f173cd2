//! `coflash more shell`: runs several commands one after another.

use std::io::IsTerminal;
use std::sync::atomic::Ordering;

use clap::Args;
use coflash_core::Error;
use rustyline::error::ReadlineError;
use rustyline::DefaultEditor;

use crate::context::Context;
use crate::device::{asked, cancelled};
use crate::memory;
use crate::output::Failure;
use crate::secrets;

/// Reads commands from the keyboard or from standard input and runs them.
///
/// From the keyboard, with a history; from standard input, one on each line.
///
/// The options of the command line (--bus, --json and so on) apply to all commands. `exit` or
/// Ctrl-D ends the shell. If a command from standard input fails, the shell ends.
#[derive(Debug, Args)]
pub(crate) struct Shell {}

/// Runs one line of the shell.
pub(crate) type Runner = fn(&Context, Vec<String>) -> Result<(), Failure>;

impl Shell {
    /// Reads commands and runs each of them with `command`.
    pub(crate) fn run(&self, context: &Context, command: Runner) -> Result<(), Failure> {
        let interactive = std::io::stdin().is_terminal();
        let history = interactive.then(|| memory::file("history")).and_then(|history| {
            let lost = |why: &String| context.out.warn(format_args!("this shell leaves no history: {why}"));
            history.inspect_err(lost).ok()
        });
        let mut editor = DefaultEditor::new()
            .map_err(|error| Failure::system(format!("the line editor does not start: {error}")))?;
        if let Some(history) = &history {
            // At the first start there is no history.
            let _ = editor.load_history(history);
        }
        loop {
            // A signal before this line has ended the line before.
            cancelled()?.store(false, Ordering::Relaxed);
            let line = match asked(|| editor.readline(if interactive { "coflash> " } else { "" }))? {
                Ok(line) => line,
                Err(ReadlineError::Interrupted) => continue,
                Err(ReadlineError::Eof) => break,
                Err(error) => return Err(Failure::system(format!("standard input cannot be read: {error}"))),
            };
            let words = split(&line)?;
            match words.first().map(String::as_str) {
                None => continue,
                Some("exit" | "quit") => break,
                Some(word) if word.starts_with('#') => continue,
                Some(_) => {}
            }
            if interactive && !secrets::are_in(&words) {
                let _ = editor.add_history_entry(&line);
            }
            match (command(context, words), interactive) {
                // What ends by a signal as it should, such as monitor, ends a script with it.
                (Ok(()), false) if cancelled()?.load(Ordering::Relaxed) => {
                    return Err(Error::Cancelled.into())
                }
                (Ok(()), _) => {}
                (Err(failure), true) => context.out.failure(&failure),
                (Err(failure), false) => return Err(failure),
            }
        }
        if let Some(history) = history {
            if let Err(error) = editor.save_history(&history) {
                context.out.detail(format_args!("{}: cannot be written: {error}", history.display()));
            }
        }
        Ok(())
    }
}

/// Splits a line at blanks; quotes keep blanks inside a word.
fn split(line: &str) -> Result<Vec<String>, Failure> {
    let mut words = Vec::new();
    let mut word: Option<String> = None;
    let mut quote = None;
    for letter in line.chars() {
        match (quote, letter) {
            (Some(open), letter) if letter == open => quote = None,
            (Some(_), letter) => word.get_or_insert_default().push(letter),
            (None, '"' | '\'') => {
                quote = Some(letter);
                word.get_or_insert_default();
            }
            (None, letter) if letter.is_whitespace() => words.extend(word.take()),
            (None, letter) => word.get_or_insert_default().push(letter),
        }
    }
    if quote.is_some() {
        return Err(Failure::usage("a quotation mark is not closed", "close it, or leave it out"));
    }
    words.extend(word);
    Ok(words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_cut_at_blanks_outside_quotes() {
        let words = |line| split(line).map_err(|failure| failure.to_string());
        assert_eq!(words("  flash  'my app.elf' -N 5 ").unwrap(), ["flash", "my app.elf", "-N", "5"]);
        assert_eq!(words(r#"a"b c"d '' "#).unwrap(), ["ab cd", ""]);
        assert_eq!(words("").unwrap().len(), 0);
        assert!(words("flash 'x").unwrap_err().contains("not closed"));
    }
}
