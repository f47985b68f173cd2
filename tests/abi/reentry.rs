//! The way back in C (`examples/c/coboot/reentry.c`) beside that in Rust (`coboot_app::departure`): whatever
//! comes, in whatever order, both do the same.

use std::fmt::Write as _;
use std::process::Command;

use coboot_app::departure::{Departure, Next};
use kit::random::Random;

use crate::compiler::{include, succeed};
use crate::header::clang;

/// Reads a script of events, and prints what the program does about each: for `b REQUEST NOW`, a command
/// that was taken, whether it is possible; for `p QUIET NOW`, the next step, and in the end the request.
/// `n` begins anew.
const HARNESS: &str = r#"
#include <stdio.h>
#include "coboot.h"

/* What coboot.h has for the chip alone. */
#define coboot_callgate() NULL
#define coboot_read_handoff(handoff) ((void)(handoff), false)
#define coboot_nameplate(handoff) NULL
#define coboot_program_info(gate, number, info) ((void)(number), (void)(info), COBOOT_STATUS_FAILED)
#define coboot_confirm(gate, number) COBOOT_STATUS_FAILED
#define coboot_unconfirm(gate, number) COBOOT_STATUS_FAILED
#define coboot_store_node(gate, node_id, bit_rate) COBOOT_STATUS_FAILED
#define coboot_reset(request, argument) printf("%u %u", request, argument)
#include "program.c"

int main(int count, char **words)
{
    struct coboot_reentry reentry = { 0 };
    FILE *script = count == 2 ? fopen(words[1], "r") : NULL;
    unsigned long what, now;
    char event;

    if (script == NULL) {
        return 1;
    }
    while (fscanf(script, " %c %lu %lu", &event, &what, &now) == 3) {
        if (event == 'n') {
            const struct coboot_reentry none = { 0 };
            reentry = none;
        } else if (event == 'b') {
            const uint32_t argument = coboot_owed(1, 0, (uint8_t)(what >> 8));
            const bool possible = coboot_reentry_begin(&reentry, what & 0xFF, argument, (uint32_t)now);
            puts(possible ? "taken" : "refused");
        } else {
            const enum coboot_next next = coboot_reentry_proceed(&reentry, what != 0, (uint32_t)now);
            if (next == COBOOT_LEAVE) {
                printf("leave %u\n", reentry.request | (uint32_t)coboot_owed_node(reentry.argument) << 8);
            } else {
                puts(next == COBOOT_SERVE ? "serve" : "wait");
            }
        }
    }
    /* STOP, where the bootloader cannot answer. */
    struct coboot_program stopped;
    coboot_program_init(&stopped, 1, 0);
    coboot_program_write(&stopped, COBOOT_PROGRAM_CONTROL, 1, 0, 0);
    printf(coboot_program_is_silent(&stopped) ? "silent " : "answers ");
    coboot_program_proceed(&stopped, false, 500);
    return 0;
}
"#;

/// Requests of the warm-start cell by their numbers: stay, start, power-on, an answer that is owed
/// (for node 5), a STOP that was answered, confirm, store node, rescue.
const REQUESTS: [u32; 8] = [STAY, 3, 5, OWED, STOPPED, CONFIRM, STORE_NODE, 16];
const STAY: u32 = 1;
const OWED: u32 = 5 << 8 | STOPPED;
const STOPPED: u32 = 7;
const CONFIRM: u32 = 10;
const STORE_NODE: u32 = 12;

fn stores(request: u32) -> bool {
    matches!(request, CONFIRM | STORE_NODE)
}

/// What an application on `Departure` does: the rules that are outside of it are those of
/// `app-template/src/objects.rs`.
#[derive(Default)]
struct Model {
    departure: Option<Departure<u32>>,
    /// The last request on which somebody relies.
    promised: Option<u32>,
    silent: bool,
    stopped: bool,
}

impl Model {
    fn begin(&mut self, request: u32, now: u32) -> bool {
        // A value to store and another promise exclude each other (`ProgramControl`).
        let excludes = |before| before != request && (stores(before) || stores(request));
        if self.silent || self.promised.is_some_and(excludes) {
            return false;
        }
        let departure = self.departure.get_or_insert_default();
        if request == OWED {
            departure.begin_silent(request, now);
            self.silent = true;
        } else {
            let request = if request == STAY && self.stopped { STOPPED } else { request };
            departure.begin(request, !matches!(request, 3 | 5 | 16), now);
            self.stopped = request == STOPPED || self.stopped && matches!(request, 3 | 5 | 16);
        }
        if !matches!(request, 3 | 5 | 16) {
            self.promised = Some(request);
        }
        true
    }

    fn proceed(&mut self, quiet: bool, now: u32) -> Next<u32> {
        self.departure.as_mut().map_or(Next::Serve, |departure| departure.proceed(quiet, now))
    }
}

#[test]
fn c_and_rust_leave_at_the_same_time_with_the_same_request() {
    let mut random = Random(0x1F51);
    let (mut script, mut expected) = (String::new(), Vec::new());
    let mut left = [0_usize; REQUESTS.len()];
    for _ in 0..3000 {
        // Also where the counter of milliseconds runs over.
        let mut now =
            if random.chance(50) { u32::MAX - random.below(600) as u32 } else { random.next() as u32 };
        let mut model = Model::default();
        writeln!(script, "n 0 {now}").unwrap();
        for _ in 0..200 {
            let request = random.chance(8).then(|| random.pick(&REQUESTS));
            let outcome = if let Some(request) = request {
                writeln!(script, "b {request} {now}").unwrap();
                let possible = model.begin(request, now);
                if possible { "taken" } else { "refused" }.to_owned()
            } else {
                let quiet = random.chance(70);
                writeln!(script, "p {} {now}", u8::from(quiet)).unwrap();
                match model.proceed(quiet, now) {
                    Next::Serve => "serve".to_owned(),
                    Next::Wait => "wait".to_owned(),
                    Next::Leave(request) => format!("leave {request}"),
                }
            };
            let leaves: Option<u32> = outcome.strip_prefix("leave ").and_then(|request| request.parse().ok());
            expected.push(outcome);
            if let Some(request) = leaves {
                left[REQUESTS.iter().position(|known| *known == request).expect("one of them")] += 1;
                break;
            }
            now = now.wrapping_add(random.below(4) as u32);
        }
    }
    assert!(left.iter().all(|count| *count > 50), "not every request was seen: {left:?}");

    let folder = kit::folder!("reentry");
    let (source, events) = (folder.write("harness.c", HARNESS), folder.write("events", script));
    let program = folder.join("harness");
    let library = include();
    let mut compiler = clang();
    compiler.args(["-std=c11", "-O1", "-fsanitize=undefined", "-fsanitize-trap=undefined"]);
    compiler.arg(&source).arg(library.join("reentry.c")).arg("-o").arg(&program);
    succeed(compiler.args(["-no-pie", "-Wl,--defsym=__programs=1"]));
    let printed = succeed(Command::new(&program).arg(&events));
    let mut in_c: Vec<_> = printed.lines().collect();
    // As `coboot_app::ProgramControl`: owed by program 1, for no node.
    assert_eq!(in_c.pop(), Some("answers 7 1"));
    assert_eq!(in_c.len(), expected.len());
    let differs = in_c.iter().zip(&expected).position(|(c, rust)| c != rust);
    assert_eq!(differs, None, "event {differs:?}: C {:?}", differs.map(|at| (in_c[at], &expected[at])));
}
