//! The kept inputs of a fuzz target: one archive in `tests/fuzz/corpus`, which the fuzzer's folders are
//! filled from. A person gives names to inputs; what the fuzzer has found has a number.

use std::fs;
use std::path::{Path, PathBuf};

use crate::{files, outcome::Outcome};

/// The most bytes of what the fuzzer has found that are kept for a target, and of one input.
const KEPT: usize = 96 * 1024;
const LONGEST: usize = 4 * 1024;

/// Puts the inputs of an archive, if there is one, into a folder, which it makes; returns the folder.
pub fn unpack(archive: &Path, folder: PathBuf) -> Outcome<PathBuf> {
    files::make(&folder)?;
    if archive.exists() {
        files::unpack(archive, &folder)?;
    }
    Ok(folder)
}

/// Puts what the fuzzer has found in a folder into an archive, the shortest first, as much as [`KEPT`]
/// allows. Inputs that a person has named stay there.
pub fn keep(folder: &Path, archive: &Path) -> Outcome {
    let next = folder.with_extension("next");
    files::remove(&next)?;
    let mut named = Vec::new();
    for path in files::within(&unpack(archive, next.clone())?)? {
        let name = path.file_name().unwrap_or_default().as_encoded_bytes();
        if name.iter().all(u8::is_ascii_digit) {
            fs::remove_file(&path).map_err(|error| format!("{}: {error}.", path.display()))?;
        } else {
            named.push(files::bytes(&path)?);
        }
    }
    let mut found = Vec::new();
    for path in files::within(folder)? {
        let bytes = files::bytes(&path)?;
        if bytes.len() <= LONGEST && !named.contains(&bytes) {
            found.push((bytes.len(), bytes));
        }
    }
    found.sort();
    let mut room = KEPT;
    for (number, (length, bytes)) in found.into_iter().enumerate() {
        let Some(left) = room.checked_sub(length) else { break };
        room = left;
        files::write(&next.join(format!("{number:04}")), bytes)?;
    }
    files::pack(&next, ".", "0", archive)?;
    files::remove(&next)
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use kit::folder::Folder;

    use super::*;
    use crate::{process, workspace};

    fn folder() -> Folder {
        Folder::below(std::env::temp_dir(), "coboot-corpus")
    }

    #[test]
    fn what_was_kept_takes_part_in_the_next_smallest_corpus() {
        let folder = folder();
        let (corpus, file) = (folder.join("corpus"), folder.join("a-target"));
        unpack(&file, corpus.clone()).expect("a target without kept inputs");
        fs::write(corpus.join("b"), "new\n1 1\n").unwrap();
        fs::write(corpus.join("too-long"), vec![0; LONGEST + 1]).unwrap();
        keep(&corpus, &file).unwrap();
        fs::remove_dir_all(&corpus).unwrap();
        unpack(&file, corpus.clone()).unwrap();
        assert_eq!(fs::read(corpus.join("0000")).unwrap(), b"new\n1 1\n");
        assert!(!corpus.join("0001").exists());
    }

    #[test]
    fn what_is_kept_is_short_and_a_persons_seeds_stay() {
        let folder = folder();
        let (corpus, file) = (folder.join("corpus"), folder.join("a-target"));
        files::write(&folder.join("earlier/by-hand"), "x").unwrap();
        files::write(&folder.join("earlier/0000"), "an earlier one").unwrap();
        files::pack(&folder.join("earlier"), ".", "0", &file).unwrap();
        fs::create_dir_all(&corpus).unwrap();
        fs::write(corpus.join("a"), vec![0; 100]).unwrap();
        fs::write(corpus.join("c"), "x").unwrap();
        for number in 0..30 {
            fs::write(corpus.join(number.to_string()), vec![1; LONGEST]).unwrap();
        }
        keep(&corpus, &file).unwrap();
        let kept = files::within(&unpack(&file, folder.join("kept")).unwrap()).unwrap();
        let kept: Vec<_> = kept.iter().map(|file| fs::read(file).unwrap()).collect();
        assert!((KEPT - LONGEST..=KEPT + 1).contains(&kept.concat().len()), "{}", kept.concat().len());
        // By their names: what was found, and then by-hand.
        assert_eq!((&kept[0], kept.last()), (&vec![0; 100], Some(&b"x".to_vec())));
        assert!(kept[1..kept.len() - 1].iter().all(|bytes| bytes.len() == LONGEST));
    }

    #[test]
    fn the_kept_inputs_are_whole_and_few() {
        for file in files::within(&workspace::root().join("tests/fuzz/corpus")).unwrap() {
            if file.file_name().is_some_and(|name| name != ".gitattributes") {
                let names = process::output(Command::new("tar").arg("--list").arg("--file").arg(&file));
                assert!(names.unwrap().lines().any(|name| name != "./"), "{}", file.display());
                assert!(file.metadata().unwrap().len() < 200_000, "{}", file.display());
            }
        }
    }
}
