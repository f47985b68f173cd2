//! Job file and configuration file.
//!
//! Must hold: any text gives a job, settings, or a fault whose place is in the text; each device of
//! a job has an image and is named, and no two are the same one; each setting is one that there is.
#![no_main]

use std::path::Path;

use coflash::update::{config, job};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let lines = text.matches('\n').count() + 1;
    match job::parse(text, Path::new("folder")) {
        Err(job::Fault::Line(line, what)) => assert!((1..=lines).contains(&line) && !what.is_empty()),
        Err(job::Fault::Device(number, what)) => assert!(number >= 1 && !what.is_empty()),
        Ok(entries) => {
            assert!(!entries.is_empty());
            for (i, entry) in entries.iter().enumerate() {
                assert!(entry.node.is_some() || entry.address.is_some());
                assert!(entry.settings.image.is_some());
                assert!(entry.settings.program.is_none_or(|program| (1..=254).contains(&program)));
                for other in &entries[..i] {
                    assert!(entry.node.is_none() || entry.node != other.node);
                    assert!(entry.address.is_none() || entry.address != other.address);
                }
            }
        }
    }
    match config::parse(text) {
        Err(config::Fault::Line(line, what)) => assert!((1..=lines).contains(&line) && !what.is_empty()),
        Err(config::Fault::Setting(what)) => assert!(!what.is_empty()),
        Ok(settings) => {
            assert!(settings.iter().all(|(key, _)| config::KEYS.contains(&key.as_str())));
        }
    }
});
