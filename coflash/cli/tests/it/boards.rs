//! `--board FILE.toml`: a board that the tool was not built with, in every command that takes a board.

use std::fs;

use coflash_core::file::{ihex, raw};
use kit::folder::Folder;
use shared_abi::layout::nucleo_f446re::LAYOUT;
use shared_abi::layout::toml::Toml;

use crate::sealing;
use crate::tool::{coflash, data, folder, Done};
use kit::fake::{serve, Fake, APPLICATION};

/// The commands with `--board`, as the manual pages name them: these are made of the definition of the
/// command line.
fn commands_with_a_board(folder: &Folder) -> Vec<String> {
    coflash(&["more", "man", "--out", &folder.path("pages")]).good();
    let mut found = Vec::new();
    for page in fs::read_dir(folder.path("pages")).unwrap() {
        let page = page.unwrap();
        if fs::read_to_string(page.path()).unwrap().contains("\\fB\\-\\-board\\fR") {
            let name = page.file_name().into_string().unwrap();
            found.push(name.trim_start_matches("coflash-").trim_end_matches(".1").to_owned());
        }
    }
    found.sort();
    found
}

/// Those of production read a bootloader, too.
const OF_PRODUCTION: [&str; 2] = ["seal-factory", "seal-provision"];

/// What the commands need, and how they are called.
struct Room {
    folder: Folder,
    calls: Vec<(&'static str, Vec<String>)>,
}

impl Room {
    fn new(name: &str) -> Self {
        let folder = sealing::Room::new(name).0;
        let path = |name: &str| folder.path(name);
        // A resident part that knows sealed images (`MARK_OFFSET`).
        let mut resident = vec![0x5A; 992];
        resident[0x1C..0x20].copy_from_slice(b"CBS1");
        let image = raw::read(&resident, Some(LAYOUT.bootloader.base)).unwrap();
        folder.file("bootloader.hex", ihex::emit(&image).as_bytes());
        let seal = format!(
            "seal image {} --key {} --cert {} --counter 1 --vid 0x3F --pid 1 --ver 0x10001 -o {}",
            data("program.hex"),
            path("release.pem"),
            path("release.cert"),
            path("out.cbs")
        );
        let (boot, root, out) = (path("bootloader.hex"), path("root.pub"), path("p.hex"));
        let calls = [
            ("convert", format!("convert {} {}", data("program.hex"), path("out.blk"))),
            ("flash", format!("flash {} --node 5", data("program.hex"))),
            ("inspect", format!("inspect {}", data("program.hex"))),
            (
                "more-conform",
                format!("more conform SDO-001 --install --image {} --node 5", data("program.hex")),
            ),
            ("seal-factory", format!("seal factory {boot} {} -o {out} --force", data("program.hex"))),
            ("seal-image", seal),
            ("seal-provision", format!("seal provision {boot} --root {root} -o {out} --force")),
        ]
        .map(|(name, line)| (name, line.split(' ').map(str::to_owned).collect()));
        Self { folder, calls: calls.into() }
    }

    fn call(words: &[String], more: &[&str]) -> Done {
        coflash(&[&words.iter().map(String::as_str).collect::<Vec<_>>()[..], more].concat())
    }
}

/// The map of a board under a name that the tool does not know.
fn map() -> String {
    Toml(&LAYOUT).to_string().replace("nucleo-f446re", "my-board")
}

#[test]
fn a_board_may_be_a_file_in_every_command() {
    let room = Room::new("board-file");
    let names: Vec<_> = room.calls.iter().map(|(name, _)| *name).collect();
    assert_eq!(commands_with_a_board(&room.folder), names, "each needs a call in this test");
    let board = room.folder.file("my board.toml", map().as_bytes());
    let higher = map().replace("base = 0x08010000, size = 0x70000", "base = 0x08020000, size = 0x60000");
    assert_ne!(higher, map());
    let higher = room.folder.file("higher.toml", higher.as_bytes());
    for (name, words) in room.calls.iter().filter(|(name, _)| !OF_PRODUCTION.contains(name)) {
        let (bus, server) = serve(Fake::new(APPLICATION));
        let is_on_the_bus = ["more-conform", "flash"].contains(name);
        let more: &[&str] = if is_on_the_bus { &["--bus", &bus] } else { &[] };
        Room::call(words, &[more, &["--board", &board]].concat()).good();
        if is_on_the_bus {
            server.join().unwrap();
        }
        // It is this map that counts: the file's program begins below the program of the other one.
        Room::call(words, &[more, &["--board", &higher]].concat()).fails(3, &["0x08010000"]);
    }
    // The bootloader is not whole.
    let (_, words) = room.calls.iter().find(|(name, _)| *name == "seal-factory").unwrap();
    Room::call(words, &["--board", &board]).fails(3, &["bootloader.hex"]);
    // A compact board has no place for keys.
    let (_, words) = room.calls.iter().find(|(name, _)| *name == "seal-provision").unwrap();
    Room::call(words, &["--board", &board]).fails(3, &["compact memory map"]);
    let split = Toml(&shared_abi::layout::stm32f407g_disc1::LAYOUT).to_string();
    let split = room.folder.file("split.toml", split.as_bytes());
    let done = Room::call(words, &["--board", &split]);
    assert!(!done.err.contains("compact memory map"), "{}", done.err);
}

#[test]
fn a_hostile_file_is_refused_with_its_name_and_line_before_the_bus_is_used() {
    let room = Room::new("board-hostile");
    let files: [(&str, Vec<u8>, &str); 8] = [
        ("empty.toml", Vec::new(), "empty.toml: line 1: missing field"),
        ("cut.toml", map().into_bytes()[..300].to_vec(), "cut.toml: line "),
        (
            "rule.toml",
            map().replace("base = 0x08010000", "base = 0x0800c000").into(),
            "rule.toml: a program must start",
        ),
        ("field.toml", format!("speed = 5\n{}", map()).into(), "field.toml: line 1: unknown field `speed`"),
        ("huge.toml", vec![b'#'; 70_000], "huge.toml: a memory map has 64 KiB at most"),
        ("bytes.toml", vec![0xFF, 0xFE, 0], "bytes.toml: line 1: "),
        ("deep.toml", format!("a = {}", "[".repeat(60_000)).into(), "deep.toml: line 1: "),
        ("escape.toml", b"\"\\u001b[2J\" = 1".to_vec(), "escape.toml: line 1: unknown field"),
    ];
    for (name, bytes, says) in &files {
        let file = room.folder.file(name, bytes);
        for (_, words) in &room.calls {
            let done = Room::call(words, &["--board", &file, "--bus", "socketcand://127.0.0.1:1/x"]);
            done.fails(3, &[says]);
            assert!(!done.err.contains('\u{1b}'), "{words:?}");
        }
    }
    for (word, exit, says) in [
        (room.folder.path("none.toml"), 3, "none.toml: "),
        (room.folder.path("."), 3, "."),
        ("arduino".to_owned(), 2, "For another one give the file with its memory map"),
    ] {
        for (_, words) in &room.calls {
            Room::call(words, &["--board", &word]).fails(exit, &[says]);
        }
    }
}

/// In a settings file the path is relative to its folder.
#[test]
fn a_job_file_names_a_board_by_a_file_beside_it() {
    let folder = folder("board-job");
    folder.file("my-board.toml", map().as_bytes());
    folder.file("app.hex", &fs::read(data("program.hex")).unwrap());
    let job = |board: &str| {
        let text = format!("board = '{board}'\n[[program]]\nimage = 'app.hex'\nprogram = 2\nnodes = [5]\n");
        let job = folder.file("line.toml", text.as_bytes());
        coflash(&["flash", "--job", &job, "--bus", "socketcand://127.0.0.1:1/x"])
    };
    let done = job("my-board.toml");
    done.fails(2, &["my-board has no program 2"]);
    let done = job("none.toml");
    done.fails(3, &["none.toml: "]);
    let done = job("arduino");
    done.fails(2, &["there is no board 'arduino'"]);
}
