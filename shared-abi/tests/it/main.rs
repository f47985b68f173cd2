//! The numbers and formats of the ABI against its documents.

mod block_file;
mod check_word;
mod layout_rules;
mod layout_texts;
mod lines;
