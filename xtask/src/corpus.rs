//! The kept inputs of a fuzz target: one file in `tests/fuzz/corpus`, which the fuzzer's folders are
//! filled from.
//!
//! An input is a line with its name and its length, its bytes, and a line feed. A person gives names;
//! what the fuzzer has found has a number.

use std::path::{Path, PathBuf};

use crate::{files, outcome::Outcome, workspace};

/// The most bytes of what the fuzzer has found that are kept for a target, and of one input.
const KEPT: usize = 96 * 1024;
const LONGEST: usize = 4 * 1024;

/// A name and the bytes of an input.
type Input = (String, Vec<u8>);

/// The inputs of a file; none if there is no file.
fn read(file: &Path) -> Outcome<Vec<Input>> {
    if !file.exists() {
        return Ok(Vec::new());
    }
    let bytes = files::bytes(file)?;
    let (mut rest, mut inputs) = (&bytes[..], Vec::new());
    while !rest.is_empty() {
        let input = next(&mut rest)
            .ok_or_else(|| format!("{} is damaged after {} inputs.", workspace::shown(file), inputs.len()))?;
        inputs.push(input);
    }
    Ok(inputs)
}

fn next(rest: &mut &[u8]) -> Option<Input> {
    let end = rest.iter().position(|byte| *byte == b'\n')?;
    let (name, length) = std::str::from_utf8(&rest[..end]).ok()?.split_once(' ')?;
    // The name becomes that of a file.
    let is_plain = name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
    let (bytes, behind) = rest[end + 1..].split_at_checked(length.parse().ok()?)?;
    *rest = behind.strip_prefix(b"\n")?;
    (is_plain && !name.is_empty()).then(|| (name.to_owned(), bytes.to_vec()))
}

/// Puts each input into a file in a folder, which it makes; returns the folder.
pub fn unpack(file: &Path, folder: PathBuf) -> Outcome<PathBuf> {
    files::make(&folder)?;
    for (name, bytes) in read(file)? {
        files::write(&folder.join(name), bytes)?;
    }
    Ok(folder)
}

/// Puts what the fuzzer has found in a folder into a file, the shortest first, as much as [`KEPT`]
/// allows. Inputs that a person has named stay there.
pub fn keep(folder: &Path, file: &Path) -> Outcome {
    let is_number = |name: &str| name.bytes().all(|byte| byte.is_ascii_digit());
    let mut inputs: Vec<Input> = read(file)?;
    inputs.retain(|(name, _)| !is_number(name));
    let mut found = Vec::new();
    for path in files::within(folder)? {
        let bytes = files::bytes(&path)?;
        if bytes.len() <= LONGEST && !inputs.iter().any(|(_, named)| *named == bytes) {
            found.push((bytes.len(), bytes));
        }
    }
    found.sort();
    let mut room = KEPT;
    for (number, (length, bytes)) in found.into_iter().enumerate() {
        let Some(left) = room.checked_sub(length) else { break };
        room = left;
        inputs.push((format!("{number:04}"), bytes));
    }
    let mut text = Vec::new();
    for (name, bytes) in inputs {
        text.extend_from_slice(format!("{name} {}\n", bytes.len()).as_bytes());
        text.extend_from_slice(&bytes);
        text.push(b'\n');
    }
    files::write(file, text)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use kit::folder::Folder;

    use super::*;

    fn folder() -> Folder {
        Folder::below(std::env::temp_dir(), "coboot-corpus")
    }

    #[test]
    fn what_was_kept_takes_part_in_the_next_smallest_corpus() {
        let folder = folder();
        let (corpus, file) = (folder.join("corpus"), folder.join("a-target"));
        unpack(&file, corpus.clone()).expect("a target without kept inputs");
        fs::write(corpus.join("b"), "new\n1 1\n").unwrap();
        keep(&corpus, &file).unwrap();
        fs::remove_dir_all(&corpus).unwrap();
        unpack(&file, corpus.clone()).unwrap();
        assert_eq!(fs::read(corpus.join("0000")).unwrap(), b"new\n1 1\n");
    }

    #[test]
    fn what_is_kept_is_short_and_a_persons_seeds_stay() {
        let folder = folder();
        let (corpus, file) = (folder.join("corpus"), folder.join("a-target"));
        fs::create_dir_all(&corpus).unwrap();
        fs::write(&file, "by-hand 1\nx\n0000 14\nan earlier one\n").unwrap();
        fs::write(corpus.join("a"), vec![0; 100]).unwrap();
        fs::write(corpus.join("b"), vec![0; LONGEST + 1]).unwrap();
        fs::write(corpus.join("c"), "x").unwrap();
        for number in 0..30 {
            fs::write(corpus.join(number.to_string()), vec![1; LONGEST]).unwrap();
        }
        keep(&corpus, &file).unwrap();
        let kept = read(&file).unwrap();
        let bytes: usize = kept.iter().map(|(_, bytes)| bytes.len()).sum();
        assert!((KEPT - LONGEST..=KEPT + 1).contains(&bytes), "{bytes}");
        assert_eq!(kept[0], ("by-hand".to_owned(), b"x".to_vec()));
        assert_eq!(kept[1], ("0000".to_owned(), vec![0; 100]));
        assert!(kept[2..].iter().all(|(_, bytes)| bytes.len() == LONGEST));
    }

    #[test]
    fn a_damaged_file_is_refused() {
        let folder = folder();
        let file = folder.join("a-target");
        for text in
            ["a", "a 1", "a 1\n", "a 1\nxx", "a 2\nx\n", "../a 1\nx\n", " 1\nx\n", "a x\nx\n", "a 1\nx\nb"]
        {
            fs::write(&file, text).unwrap();
            assert!(read(&file).is_err(), "{text:?}");
        }
    }

    #[test]
    fn the_kept_inputs_are_whole_and_few() {
        let kept = workspace::root().join("tests/fuzz/corpus");
        for file in files::within(&kept).unwrap() {
            if file.file_name().is_some_and(|name| name != ".gitattributes") {
                assert!(!read(&file).unwrap().is_empty(), "{}", file.display());
                assert!(file.metadata().unwrap().len() < 200_000, "{}", file.display());
            }
        }
    }
}
