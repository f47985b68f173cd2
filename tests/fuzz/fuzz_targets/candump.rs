//! Lines of a candump log.
//!
//! Must hold: any text gives a frame, nothing, or an error that can be shown; a parsed frame is
//! written in a form that parses to the same frame, with the same description in words.
#![cfg_attr(fuzzing, no_main)]

use coboot_can::candump::Line;
use coboot_can::decode::Decoder;

coboot_fuzz::target!(|bytes: &[u8]| {
    let text = String::from_utf8_lossy(bytes);
    let mut decoder = Decoder::new();
    for line in text.lines() {
        match Line::parse(line) {
            Err(error) => assert!(!error.is_empty()),
            Ok(None) => {}
            Ok(Some(found)) => {
                let again = Line::parse(&found.to_string()).expect("what was written reads back");
                let again = again.expect("as a frame");
                assert_eq!((&again.interface, again.frame), (&found.interface, found.frame));
                // The resolution of a log is microseconds.
                assert_eq!(again.time.as_micros(), found.time.as_micros());
                let _ = decoder.decode(&found.frame);
            }
        }
    }
});
