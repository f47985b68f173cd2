//! The pages, typed by a new user: each command and each code block of a page runs, in the order of
//! the page and in one folder, or a mark before the block says why it does not.
//!
//! | comment in front of a block | what it says |
//! |---|---|
//! | `not run: REASON` | it does not run, for a reason of [`REASONS`]. `elsewhere: FILE` names the test that runs it: the file has its lines, or reads them from the page |
//! | `bus: PROGRAM OPTIONS` | from here on the commands find this device: `coboot-node` or `emulate` |
//! | `first: COMMAND` | what the page assumes to be there, such as a file of the reader's |
//! | `file: NAME` | the block is the content of this file |
//! | `fails` | the command shows an error, and fails |
//! | `from FILE` | the block is quoted; the build of FILE compiles it |
//!
//! The commands are those of the page, with the programs of this build: `cargo run -p coflash --` is
//! `coflash`, and `cargo xtask emulate` is the emulator with the images that `cargo xtask build` has
//! made before. The port 29536 of the pages is a free one, and `/dev/pts/5` the terminal that the emulator has named.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;
use std::time::Duration;
use std::{env, fs};

use coboot_tests::firmware;
use coboot_tests::masters::{lely, Master};
use coboot_tests::tools::{given, succeeded, text};
use kit::folder::Folder;
use shared_abi::layout::stm32f407g_disc1;

/// Why a block does not run.
const REASONS: [&str; 6] = [
    // It needs an adapter, a board or a debug probe.
    "hardware",
    // It changes the machine.
    "root",
    // It needs a program or a server of others that the tests do not install.
    "foreign service",
    "network",
    // A job of the repository that takes minutes: CI, or the night, runs it.
    "job",
    // Another test runs it: the mark has its file.
    "elsewhere",
];

/// The port of the pages, at which a board or a node offers its bus.
const PORT: &str = "29536";

/// The pages that have something to run, each with a test of its own below.
macro_rules! pages {
    ($($name:ident $page:literal)*) => {
        const PAGES: &[&str] = &[$($page),*];
        $(
            #[test]
            fn $name() {
                run($page);
            }
        )*
    };
}

pages! {
    readme "README.md"
    application "docs/application.md"
    can_over_uart "docs/can-over-uart.md"
    coflash "docs/coflash.md"
    debugger "docs/debugger.md"
    example_c "examples/c/README.md"
    example_cpp "examples/cpp/README.md"
    example_embassy "examples/embassy/README.md"
    example_no_stack "examples/no-stack/README.md"
    example_rtic "examples/rtic/README.md"
    conform "docs/conform.md"
    first_hour "docs/first-hour.md"
    fleet "docs/fleet.md"
    emulator "docs/emulator.md"
    machine_package "docs/machine-package.md"
    masters "docs/masters.md"
    node "docs/node.md"
    product "docs/product.md"
    renewal "docs/renewal.md"
    security "docs/security.md"
    service "docs/service.md"
    testing "docs/testing.md"
    ui "docs/ui.md"
    node_readme "sim/node/README.md"
}

/// A block of code of a page.
struct Block {
    /// The page and the line.
    place: String,
    language: String,
    code: String,
    /// The comments in front of it.
    comments: Vec<String>,
}

/// What happens to a block.
#[derive(Debug, PartialEq, Eq)]
enum Kind {
    /// Commands for a shell.
    Commands(String),
    Python,
    /// The content of a file with this name.
    File(String),
    /// A mark, with its reason.
    Marked(&'static str),
    /// The build compiles it where it is quoted from, or the page is a part of its crate.
    Compiled,
    /// An output, or data to look at.
    Output,
}

impl Block {
    /// The rest of the comment that begins so.
    fn comment(&self, word: &str) -> Option<&str> {
        self.comments.iter().find_map(|comment| comment.strip_prefix(word))
    }

    /// # Errors
    /// The block neither runs nor has a mark.
    fn kind(&self) -> Result<Kind, String> {
        if let Some(mark) = self.comment("not run: ") {
            return self.marked(mark).map(Kind::Marked).map_err(|error| format!("{}: {error}", self.place));
        }
        if let Some(name) = self.comment("file: ") {
            return Ok(Kind::File(name.to_owned()));
        }
        let prompted = prompted(&self.code);
        match self.language.as_str() {
            "sh" => Ok(Kind::Commands(self.code.clone())),
            "" | "console" if !prompted.is_empty() => Ok(Kind::Commands(prompted)),
            "python" => Ok(Kind::Python),
            "" | "text" | "json" => Ok(Kind::Output),
            _ if self.comment("from ").is_some() || self.is_of_a_crate() => Ok(Kind::Compiled),
            other => Err(format!("{}: {other} neither runs nor has a mark", self.place)),
        }
    }

    /// The reason of a mark in front of it.
    fn marked(&self, mark: &str) -> Result<&'static str, String> {
        let (reason, file) =
            mark.split_once(": ").map_or((mark, None), |(reason, file)| (reason, Some(file)));
        let known = REASONS.into_iter().find(|known| *known == reason);
        let known =
            known.ok_or_else(|| format!("\"{reason}\" is no reason; there are: {}", REASONS.join(", ")))?;
        match (known, file) {
            ("elsewhere", file) => {
                let source = fs::read_to_string(root().join(file.unwrap_or_default()));
                let source =
                    source.map_err(|_| format!("\"{mark}\" names no file of a test that runs it"))?;
                let missing = self.missing_from(&source);
                missing.map_or(Ok(known), |line| Err(format!("\"{mark}\" does not have the line: {line}")))
            }
            (_, None) => Ok(known),
            (_, Some(_)) => Err(format!("\"{mark}\": only \"elsewhere\" names a file")),
        }
    }

    /// The first line that a test neither has, word for word, nor reads from the page: then it names the page, and cuts
    /// the block out, or finds commands by their first words.
    fn missing_from(&self, source: &str) -> Option<String> {
        let page = self.place.split(':').next().unwrap_or_default();
        let is_command = ["", "sh", "console"].contains(&&*self.language);
        let mut texts = source.split('"').filter(|text| text.trim().len() > 8 && text.trim().contains(' '));
        let finds =
            if is_command { texts.any(|text| self.code.contains(text)) } else { source.contains("```") };
        if finds && source.contains(page) {
            return None;
        }
        let (prompted, source) =
            (prompted(&self.code), source.lines().map(words).collect::<Vec<_>>().join(" "));
        let mut lines = if prompted.is_empty() { &self.code } else { &prompted }.lines();
        lines.find(|line| !format!(" {source} ").contains(&format!(" {} ", words(line)))).map(str::to_owned)
    }

    /// What the comments in front of it ask for, in their order.
    fn before(&self) -> String {
        let line = |comment: &String| match comment.split_once(": ")? {
            ("bus", device) => Some(format!("bus {device}\n")),
            ("first", command) => Some(format!("{command}\n")),
            _ => None,
        };
        self.comments.iter().filter_map(line).collect()
    }

    /// Its commands, shown as they run. An error that the page shows must come.
    fn typed(&self, commands: &str) -> String {
        let commands = if self.comments.iter().any(|comment| comment == "fails") {
            format!("if {}; then echo 'the page shows an error here'; exit 1; fi\n", commands.trim_end())
        } else {
            commands.to_owned()
        };
        format!("echo '== {}'\nset -x\n{commands}{{ set +x; }} 2> /dev/null\n", self.place)
    }

    /// Whether the documentation tests of a crate run it: its README is a part of the library.
    fn is_of_a_crate(&self) -> bool {
        let Some((folder, _)) = self.place.split_once("README.md:") else { return false };
        let library = fs::read_to_string(root().join(folder).join("src/lib.rs")).unwrap_or_default();
        self.language.starts_with("rust") && library.contains("include_str!(\"../README.md\")")
    }
}

/// The words of a line, without what only a language puts around them, its comment, and the program that it calls: a
/// test calls that by its path.
fn words(line: &str) -> String {
    let line = line.split(" #").next().and_then(|line| line.split("//").next()).unwrap_or(line).trim();
    let line = ["coflash ", "cargo xtask "]
        .into_iter()
        .find_map(|program| line.strip_prefix(program))
        .unwrap_or(line);
    let is_between = |c: char| !c.is_alphanumeric() && !"_./:=@-".contains(c);
    let words: Vec<_> = line.split(is_between).filter(|word| !word.is_empty()).collect();
    words.join(" ")
}

/// The commands after `$ `, with the lines that continue them.
fn prompted(code: &str) -> String {
    let mut commands = String::new();
    let mut goes_on = false;
    for line in code.lines() {
        let command = if goes_on { Some(line) } else { line.trim_start().strip_prefix("$ ") };
        goes_on = command.is_some_and(|command| command.ends_with('\\'));
        commands.extend(command.into_iter().flat_map(|command| [command, "\n"]));
    }
    commands
}

/// The blocks of a page.
fn blocks(name: &str, page: &str) -> Vec<Block> {
    let mut blocks: Vec<Block> = Vec::new();
    let (mut comments, mut open) = (Vec::new(), false);
    for (number, line) in page.lines().enumerate() {
        let line = line.trim_end();
        match line.trim_start().strip_prefix("```") {
            Some(_) if open => open = false,
            Some(language) => {
                open = true;
                let place = format!("{name}:{}", number + 1);
                let (language, comments) = (language.trim().to_owned(), std::mem::take(&mut comments));
                blocks.push(Block { place, language, code: String::new(), comments });
            }
            None if open => {
                let block = blocks.last_mut().expect("it is open");
                block.code += line;
                block.code.push('\n');
            }
            None => match line.strip_prefix("<!-- ").and_then(|rest| rest.strip_suffix(" -->")) {
                Some(comment) => comments.push(comment.to_owned()),
                None if line.is_empty() => {}
                None => comments.clear(),
            },
        }
    }
    blocks
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the folder of the repository")
}

fn blocks_of(page: &str) -> Vec<Block> {
    let text = fs::read_to_string(root().join(page)).unwrap_or_else(|error| panic!("{page}: {error}"));
    blocks(page, &text)
}

/// Every page: those in `docs/`, and each README.
fn all_pages() -> Vec<String> {
    let said = Command::new("git").arg("-C").arg(root()).args(["ls-files", "*.md"]).output().expect("git");
    let said = String::from_utf8(said.stdout).expect("names");
    let is_page = |name: &&str| {
        // Pages about the past show commands of their time.
        !name.starts_with("docs/adr/") && (name.starts_with("docs/") || name.ends_with("README.md"))
    };
    said.lines().filter(is_page).map(str::to_owned).collect()
}

#[test]
fn every_block_runs_or_says_why_not() {
    let (mut faults, mut counts) = (Vec::new(), BTreeMap::<&str, usize>::new());
    let pages = all_pages();
    assert!(pages.len() > 30, "{pages:?}");
    for page in &pages {
        for block in blocks_of(page) {
            let kind = match block.kind() {
                Ok(kind) => kind,
                Err(fault) => {
                    faults.push(fault);
                    continue;
                }
            };
            let runs = matches!(kind, Kind::Commands(_) | Kind::Python | Kind::File(_));
            if runs && !PAGES.contains(&page.as_str()) {
                faults.push(format!("{}: the page has no test here", block.place));
            }
            *counts
                .entry(match kind {
                    Kind::Marked(reason) => reason,
                    Kind::Compiled => "(compiled)",
                    Kind::Output => "(output)",
                    _ => "(runs)",
                })
                .or_default() += 1;
        }
    }
    println!("blocks: {counts:?}");
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(counts["(runs)"] > 40, "{counts:?}");
}

/// A port that nobody uses now.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a port").port()
}

/// What the words of the pages mean here. `serve` starts a program that offers the page's bus, in
/// place of the one before it, and waits until it can be reached; `bus` does so for the bus of
/// `COFLASH_BUS`. A job that is no build must be one that ends at once.
const SHELL: &str = r#"
set -e
server=
own=
terminal=
stop() { [ -z "$1" ] || { kill "$1"; wait "$1" || true; } }
trap 'stop "$server"; stop "$own"' EXIT
reached() {
    until (exec 3<>"/dev/tcp/127.0.0.1/$2") 2>/dev/null; do
        kill -0 "$1" || { cat ./*.served; exit 1; }
        sleep 0.05
    done
}
serve() {
    stop "$server"
    "$@" > page.served 2>&1 &
    server=$!
    if [[ "$*" =~ 127\.0\.0\.1:([0-9]+) ]]; then
        reached "$server" "${BASH_REMATCH[1]}"
        return
    fi
    until grep -q -e '/dev/pts/' -e 'http://127' page.served; do
        kill -0 "$server" || { cat page.served; exit 1; }
        sleep 0.05
    done
    terminal=$(grep -o '/dev/pts/[0-9]*' page.served || true)
}
bus() {
    stop "$own"
    case "$1" in
    coboot-node) set -- "$COBOOT_NODE" --listen "127.0.0.1:$OWN" --folder "$(mktemp -d own.XXXX)" \
        --flash instant --stand-in "${@:2}" ;;
    emulate) set -- "$EMULATE" --socketcand "127.0.0.1:$OWN" --speed max "${@:2}" ;;
    *) echo "no device: $*"; exit 1 ;;
    esac
    "$@" > own.served 2>&1 &
    own=$!
    reached "$own" "$OWN"
}
coflash() {
    set -- "${@//\/dev\/pts\/5@/$terminal@}"
    if [ "$1" = ui ]; then serve "$COBOOT_COFLASH" "$@" < /dev/null; else "$COBOOT_COFLASH" "$@" < /dev/null; fi
}
coboot-node() { serve "$COBOOT_NODE" "$@"; }
built() { for image in "$@"; do [ -e "target/firmware/stm32f407g-disc1/$image.elf" ]; done; }
cargo() {
    case "$*" in
    "run -p coflash -- "*) coflash "${@:5}" ;;
    "run -p coboot-node -- "*) coboot-node "${@:5}" ;;
    "xtask emulate --virtual-can") serve "$EMULATE" --serial pty \
        --bootloader target/firmware/stm32f407g-disc1/bootloader-virtual-can.elf ;;
    "xtask emulate "*) serve "$EMULATE" --bootloader target/firmware/stm32f407g-disc1/bootloader.elf --speed max "${@:3}" ;;
    "xtask build"*) built "${@:3}" ;;
    "xtask layout"*) "$XTASK" "${@:2}" ;;
    *) echo "no page may run: cargo $*"; exit 1 ;;
    esac
}
bus coboot-node
"#;

/// The files that a reader of any page has: programs, bootloaders, and the tree of the repository.
fn reader(page: &str) -> Folder {
    let folder = kit::folder!(&format!("pages-{}", page.replace(['/', '.'], "-")));
    let images = firmware::dir();
    let own = [("app.elf", "app-v1.elf")];
    let same =
        "app-v1.elf app-v2.elf bootloader.elf bootloader-sealed.elf bootloader-watchdog.elf".split(' ');
    for (name, image) in own.into_iter().chain(same.map(|name| (name, name))) {
        fs::copy(images.join(image), folder.join(name)).unwrap_or_else(|error| panic!("{image}: {error}"));
    }
    #[cfg(unix)]
    {
        use std::os::unix::fs::symlink;
        let target = folder.join("target/firmware");
        fs::create_dir_all(&target).expect("a folder of the test's own");
        symlink(images, target.join(stm32f407g_disc1::LAYOUT.board)).expect("a link");
        let python = given("COBOOT_PYTHON");
        let environment = python.parent().and_then(Path::parent).expect("it is PYTHON/bin/python");
        symlink(environment, folder.join("target/python")).expect("a link");
        for tree in ["docs", "tests"] {
            symlink(root().join(tree), folder.join(tree)).expect("a link");
        }
    }
    folder
}

/// The page as a program of the shell; its port is this one.
fn program(page: &str, folder: &Folder, port: u16) -> String {
    let mut program = SHELL.to_owned();
    for (number, block) in blocks_of(page).into_iter().enumerate() {
        program += &block.before();
        match block.kind().unwrap_or_else(|fault| panic!("{fault}")) {
            Kind::Commands(commands) => program += &block.typed(&commands),
            Kind::Python => {
                let name = format!("block-{number}.py");
                folder.write(&name, block.code.replace(PORT, &port.to_string()));
                program += &block.typed(&format!("\"$COBOOT_PYTHON\" {name}\n"));
            }
            Kind::File(name) => drop(folder.write(name, block.code.replace(PORT, &port.to_string()))),
            Kind::Marked(_) | Kind::Compiled | Kind::Output => {}
        }
    }
    program += "stop \"$server\"\nserver=\n";
    program.replace(PORT, &port.to_string())
}

/// Types a page.
fn run(page: &str) {
    let folder = reader(page);
    folder.write("page.sh", program(page, &folder, free_port()));
    let built = |name: &str| given("COBOOT_COFLASH").with_file_name(name);
    let own = free_port();
    // A page that waits for ever ends; how long it takes is not measured.
    let mut shell = Command::new("timeout");
    shell.args(["--kill-after=10", "300", "bash", "page.sh"]).current_dir(&*folder);
    shell.env("EMULATE", built("emulate")).env("XTASK", built("xtask")).env("OWN", own.to_string());
    shell.env("COFLASH_BUS", format!("socketcand://127.0.0.1:{own}/can0")).env_remove("COFLASH_CONFIG");
    let path = env::var("PATH").unwrap_or_default();
    let python = given("COBOOT_PYTHON");
    shell.env("PATH", format!("{}:{path}", python.parent().expect("it is a file").display()));
    let output = shell.output().expect("bash and timeout are there");
    assert!(output.status.success(), "{page} fails as printed: {}\n{}", output.status, text(&output));
}

/// The values of a list of `dcfgen`'s configuration for node 1, if it has them.
fn expected(dcf: &str, object: &str) -> Option<u32> {
    let (_, list) = dcf.split_once(&format!("[{object}Value]"))?;
    let value = list
        .lines()
        .take_while(|line| !line.starts_with('['))
        .skip(1)
        .find_map(|line| line.strip_prefix("1="));
    value.and_then(|value| u32::from_str_radix(value.trim().trim_start_matches("0x"), 16).ok())
}

/// What Lely's boot slave process compares before the update, and again after it
/// (`src/co/nmt_boot.c`): the master's object, and that of the device. An expected 0 is not compared.
const COMPARED: [(&str, (u16, u8)); 5] = [
    ("1F84", (0x1000, 0)),
    ("1F85", (0x1018, 1)),
    ("1F86", (0x1018, 2)),
    ("1F87", (0x1018, 3)),
    ("1F88", (0x1018, 4)),
];

/// Lely's master, configured by `dcfgen` as the page says, updates the node that the page starts.
#[test]
fn lelys_recipe_updates_the_node_of_the_page() {
    let page = "docs/masters.md";
    let folder = reader(page);
    let blocks = blocks_of(page);
    let of = |words: &str| blocks.iter().find(|block| block.code.contains(words)).expect("it is on the page");
    folder.write("master.yml", &of("software_file").code);
    let dcfgen = given("COBOOT_PYTHON").with_file_name("dcfgen");
    let mut dcfgen = Command::new(dcfgen);
    println!(
        "{}",
        succeeded(&dcfgen.args(["-d", ".", "master.yml"]).current_dir(&*folder).output().unwrap())
    );
    let dcf = fs::read_to_string(folder.join("master.dcf")).unwrap();
    assert!(expected(&dcf, "1F86").is_some(), "{dcf}");

    let port = free_port();
    let line = of("coboot-node --listen").code.replace(PORT, &port.to_string());
    let words: Vec<_> = line.split_whitespace().skip(1).collect();
    let mut node = Command::new(given("COBOOT_NODE")).args(words).current_dir(&*folder).spawn().unwrap();
    let url = format!("socketcand://127.0.0.1:{port}/can0");
    let mut bus = (0..200)
        .find_map(|_| {
            std::thread::sleep(Duration::from_millis(50));
            coboot_can::open(&url).ok()
        })
        .expect("the node offers its bus");
    let image = firmware::raw(firmware::APP_V1);
    let crc = kit::crc::crc32(&image);
    // Twice: the second time a program runs.
    let outcome: Result<(), String> = (|| {
        for _ in 0..2 {
            compare(&dcf, &mut *bus)?;
            lely(&mut *bus, 1, &image, crc)?;
            compare(&dcf, &mut *bus)?;
        }
        Ok(())
    })();
    node.kill().and_then(|()| node.wait()).expect("it ends");
    assert_eq!(outcome, Ok(()));
}

fn compare(dcf: &str, bus: &mut dyn coboot_can::Adapter) -> Result<(), String> {
    let mut master = Master::new(bus, 1, Duration::from_secs(2));
    for (object, (index, sub)) in COMPARED {
        let Some(expected) = expected(dcf, object).filter(|expected| *expected != 0) else { continue };
        let found = master.number(index, sub)?;
        if found != expected {
            return Err(format!(
                "{object}h wants {expected:08X}h, and {index:04X}h/{sub} reads {found:08X}h"
            ));
        }
    }
    Ok(())
}

/// A page without marks where they are needed, and with wrong ones.
#[test]
fn a_block_without_a_reason_is_found() {
    let kind = |page: &str| blocks("docs/page.md", page).pop().expect("a block").kind();
    assert_eq!(kind("```sh\na\n```\n"), Ok(Kind::Commands("a\n".to_owned())));
    assert_eq!(kind("```\n$ a \\\n  b\nc\n```\n"), Ok(Kind::Commands("a \\\n  b\n".to_owned())));
    assert_eq!(kind("```\nc\n```\n"), Ok(Kind::Output));
    assert_eq!(kind("<!-- not run: root -->\n\n```sh\na\n```\n"), Ok(Kind::Marked("root")));
    assert_eq!(kind("<!-- not run: elsewhere: README.md -->\n```js\n```\n"), Ok(Kind::Marked("elsewhere")));
    assert_eq!(kind("<!-- file: a.toml -->\n```toml\na\n```\n"), Ok(Kind::File("a.toml".to_owned())));
    let elsewhere = |line: &str| {
        kind(&format!("<!-- not run: elsewhere: tests/foreign/pages.rs -->\n```sh\n{line}\n```\n"))
    };
    assert_eq!(elsewhere("coflash \"$@\" # words of this file"), Ok(Kind::Marked("elsewhere")));
    assert!(elsewhere(&format!("coflash --nev{}", "er")).unwrap_err().contains("does not have the line"));
    // A mark holds for the block right behind it.
    assert_eq!(kind("<!-- not run: root -->\nwords\n```sh\na\n```\n"), Ok(Kind::Commands("a\n".to_owned())));
    for wrong in [
        "<!-- not run: too slow -->\n",
        "<!-- not run: elsewhere: no/such.rs -->\n",
        "<!-- not run: elsewhere -->\n",
        "",
    ] {
        assert!(kind(&format!("{wrong}```toml\na\n```\n")).is_err(), "{wrong}");
    }
}
