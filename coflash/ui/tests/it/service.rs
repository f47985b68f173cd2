//! The service station of `coflash ui --service`, without a browser.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use canopen::{Frame, NodeId};
use coflash_core::device::lock::Lock;
use coflash_core::machine::{make, Package, Recipe};
use coflash_core::update::FailedUpdate;
use coflash_ui::{Failed, Origin, Service};
use embedded_can::{Frame as _, StandardId};
use kit::fake::lift::{Lift, PHRASE};
use kit::fake::{Bus, Fake, Maker, Outcome, APPLICATION};
use kit::folder::Folder;
use kit::http::Answer;
use serde_json::{json, Value};

use super::{Ui, HEX};

/// The identity of a device; the serial number can change behind the tool's back.
struct Plate {
    product: u32,
    serial: Arc<Mutex<u32>>,
    /// 2005h, 0 for none.
    version: u32,
}

impl Maker for Plate {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        let value = match at {
            (0x1018, 1) => 63,
            (0x1018, 2) => self.product,
            (0x1018, 3) => 2,
            (0x1018, 4) => *self.serial.lock().unwrap(),
            (0x2005, 1) if self.version != 0 => self.version,
            _ => return None,
        };
        Some(Ok(value.to_le_bytes().to_vec()))
    }
}

/// A device with another program; its serial number is 1000 and its node-ID.
fn device(node: u8, product: u32) -> (Fake, Arc<Mutex<u32>>) {
    let mut fake = Fake::new(APPLICATION).at(node, 1);
    let serial = Arc::new(Mutex::new(1000 + u32::from(node)));
    fake.maker = Some(Box::new(Plate { product, serial: serial.clone(), version: 0 }));
    fake.crc_of_application = Some(0x1234_5678);
    fake.erase_time = Duration::from_millis(30);
    (fake, serial)
}

/// The package of these programs in a recipe, with one image.
fn package(folder: &Folder, programs: &str) -> Package {
    folder.write("app.hex", HEX);
    let recipe = Recipe::parse(&format!("name = 'Press 4'\n{programs}"), folder).unwrap();
    let parts = recipe.parts().unwrap();
    Package::parse(&make(recipe.name, recipe.release, &parts, &[]).unwrap()).unwrap()
}

const DRIVES: &str =
    "[[program]]\nname = 'drive'\nimage = 'app.hex'\nnodes = [5, 6]\nvendor = 63\nproduct = 1234\n";

/// A station with the reports, and what it remembers, in this folder.
fn station(folder: &Folder, package: Package, bus: Option<String>) -> Ui {
    let service = Service::new(package, "press.cpk".as_ref(), Origin::Package, &folder.join("reports"));
    let service = service.unwrap().memory(Some(folder.join("bus")));
    Ui::with(|options| (options.bus, options.service) = (bus, Some(service)))
}

/// A station for the two drives on a bus with these devices.
fn drives(folder: &Folder, devices: Vec<Fake>) -> (Ui, JoinHandle<Bus>) {
    let (bus, server) = kit::fake::serve(Bus(devices));
    (station(folder, package(folder, DRIVES), Some(bus)), server)
}

/// What a station says that does nothing more.
#[track_caller]
fn refusal(ui: &Ui) -> Value {
    ui.until("the refusal", |state| !state["message"].is_null() && state["busy"] == false)
}

/// Searches, and returns the state with the plan.
#[track_caller]
fn planned(ui: &Ui) -> Value {
    ui.until("the adapter", |state| state["open"] == true && state["busy"] == false);
    assert_eq!(ui.post("search", &json!({})).status, 200);
    ui.until("the plan", |state| !state["plan"].is_null() && state["busy"] == false)
}

/// Confirms a plan for these nodes.
fn confirm(ui: &Ui, plan: &Value, nodes: &[u8]) -> Answer {
    ui.post("update", &confirmed(plan, nodes))
}

fn confirmed(plan: &Value, nodes: &[u8]) -> Value {
    json!({
        "plan": plan["plan"], "nodes": nodes, "operator": "Jörg", "order": "A-77", "device_number": "4711",
        "language": "de",
    })
}

#[track_caller]
fn ended(ui: &Ui) -> Value {
    ui.until("the end", |state| {
        let station = state["station"].as_str().unwrap();
        state["busy"] == false && ["good", "good-unsaved", "bad"].contains(&station)
    })
}

/// Node-ID and state of each row.
fn rows(state: &Value) -> Vec<(u64, &str)> {
    let of = |row: &'_ Value| row["node"].as_u64().unwrap_or(0);
    let rows = state["rows"].as_array().unwrap();
    rows.iter().map(|row| (of(row), row["state"].as_str().unwrap())).collect()
}

/// The files of the reports with this ending, and their texts.
fn saved(folder: &Folder, ending: &str) -> Vec<(String, String)> {
    let paths = fs::read_dir(folder.join("reports")).unwrap().map(|entry| entry.unwrap().path());
    let mut paths: Vec<PathBuf> =
        paths.filter(|path| path.extension().is_some_and(|its| its == ending)).collect();
    paths.sort();
    let name = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
    paths.iter().map(|path| (name(path), fs::read_to_string(path).unwrap())).collect()
}

/// There is no way to a file, to LSS, to an erase or to the board list, and the guard is that of every page.
#[test]
fn a_station_has_nothing_but_its_package() {
    let folder = kit::folder!("service-routes");
    let ui = station(&folder, package(&folder, DRIVES), None);
    for what in ["firmware", "settings", "step", "fastscan", "assign", "scan", "close"] {
        assert_eq!(ui.post(what, &json!({})).status, 404, "{what}");
    }
    for what in ["adapters", "trace", "readback", "app.js", "index.html"] {
        assert_eq!(ui.get(what).status, 404, "{what}");
    }
    let host = ui.host_line();
    for (what, body) in [("search", &b"{}"[..]), ("update", b"{}"), ("open", b"{}"), ("save", b"{}")] {
        assert_eq!(ui.request("POST", &format!("/{what}"), &[&host], body).status, 403, "{what}");
        let lines = [host.as_str(), "Origin: http://evil.example", "Content-Type: application/json"];
        assert_eq!(ui.request("POST", &format!("{}{what}", ui.path), &lines, body).status, 403, "{what}");
    }
    // A form of another page cannot send JSON.
    let lines = [host.as_str(), "Content-Type: text/plain"];
    assert_eq!(ui.request("POST", &format!("{}update", ui.path), &lines, b"{}").status, 415);
    let long = json!({ "operator": "x".repeat(70_000) });
    assert_eq!(ui.post("update", &long).status, 413);
    for what in ["", "service.js", "service.css", "colours.css", "words.json", "station", "dom.js", "kept.js"]
    {
        let answer = ui.get(what);
        assert_eq!(answer.status, 200, "{what}");
        assert!(answer.head.contains("default-src 'none'"), "{what}: {}", answer.head);
    }
    let page = ui.get("").body;
    assert!(page.split("<script").skip(1).all(|script| script.trim_start().starts_with("src=\"")), "{page}");
    assert!(!page.contains("style=") && !page.contains("<style") && !page.contains("https://"), "{page}");
    // Without an adapter nothing begins.
    assert_eq!(ui.post("search", &json!({})).status, 409);
    assert_eq!(ui.until("the state", |_| true)["station"], "closed");
    let told = ui.get("station").json();
    assert_eq!(told["package"]["name"], "Press 4");
    assert_eq!(told["package"]["signature"], "signature-none");
    assert_eq!(told["last"], Value::Null);
}

/// Two devices of which one has its program, one that is missing, and a foreign one. Each has its outcome, and what is
/// confirmed is what was shown.
#[test]
fn a_machine_is_updated_and_each_device_has_its_report() {
    let folder = kit::folder!("service-update");
    let programs = format!("{DRIVES}[[program]]\nname = 'panel'\nimage = 'app.hex'\nnodes = [9]\n");
    let package = package(&folder, &programs);
    let crc = package.programs().next().unwrap().1.crc();
    let (mut has, _) = device(6, 1234);
    has.crc_of_application = Some(crc);
    let (bus, server) = kit::fake::serve(Bus(vec![device(5, 1234).0, has, device(20, 99).0]));
    let ui = station(&folder, package, Some(bus.clone()));
    let plan = planned(&ui);
    assert_eq!(rows(&plan), [(5, "state-due"), (6, "state-has"), (9, "state-failed")]);
    assert_eq!(plan["station"], "planned-bad");
    assert_eq!(plan["rows"][0]["identity"][3], 1005);
    assert_eq!(plan["rows"][0]["steps"][0]["from"], "CRC 12345678h");
    assert_eq!(plan["rows"][2]["trouble"]["key"], "trouble-absent");
    assert_eq!(plan["rows"][2]["trouble"]["number"], 0x6000_0013);
    assert_eq!(plan["rows"][2]["trouble"]["values"], json!({ "node": "9", "program": "panel" }));
    assert_eq!((&plan["others"][0]["node"], &plan["others"][0]["identity"][1]), (&json!(20), &json!(99)));
    assert_eq!((plan["others"].as_array().unwrap().len(), &plan["others"][0]["trouble"]), (1, &Value::Null));
    for nodes in [&[][..], &[6], &[5, 20], &[9], &[0], &[128]] {
        assert_eq!(confirm(&ui, &plan, nodes).status, 400, "{nodes:?}");
    }
    for (name, value) in [("operator", "a\nb"), ("order", "\u{1b}[2J"), ("device_number", &"x".repeat(101))] {
        let mut wrong = confirmed(&plan, &[5]);
        wrong[name] = value.into();
        assert_eq!(ui.post("update", &wrong).status, 400, "{name}");
    }
    // Another page has searched again: its plan is the one to look at.
    let newer = planned(&ui);
    assert_eq!(confirm(&ui, &plan, &[5]).status, 409);
    assert!(saved(&folder, "csv").is_empty());
    assert_eq!(confirm(&ui, &newer, &[5]).status, 200);
    let state = ended(&ui);
    assert_eq!(rows(&state), [(5, "state-updated"), (6, "state-has"), (9, "state-failed")]);
    assert_eq!((&state["station"], &state["message"]), (&json!("bad"), &Value::Null));
    // Three devices, and the sheet of the machine.
    assert_eq!((&state["unsaved"], state["saved"].as_array().unwrap().len()), (&json!(0), 4));
    // What is said follows the outcome: here a device is missing.
    assert_eq!((&state["says"], &state["rows"][2]["says"]), (&json!("bad"), &json!("state-missing")));
    // It cannot be confirmed a second time.
    assert_eq!(confirm(&ui, &newer, &[5]).status, 409);
    let reports = saved(&folder, "csv");
    let results = [("updated", "5"), ("had", "6"), ("failed", "9")];
    for ((name, text), (result, node)) in reports.iter().zip(results) {
        assert!(name.contains(&format!("_node-{node}")), "{name}");
        let line = text.lines().nth(1).unwrap();
        for words in [&format!(",{result},{node},"), ",Jörg,A-77,4711,Press 4,"] {
            assert!(line.contains(words), "{line}");
        }
    }
    let drive = ",0000003Fh,000004D2h,00000002h,000003EDh,drive,CRC 12345678h,";
    assert!(reports[0].1.contains(drive), "{}", reports[0].1);
    assert!(reports[2].1.contains(",panel,,,failed,0x60000013,"), "{}", reports[2].1);
    let pages = saved(&folder, "html");
    assert_eq!(pages.len(), 4);
    let sheet = ui.get("sheet");
    assert!(pages[0].0.ends_with("_machine.html"), "{}", pages[0].0);
    assert!(sheet.status == 200 && sheet.head.contains("style-src 'unsafe-inline'"), "{}", sheet.head);
    assert!(sheet.body.contains("Unterschrift") && sheet.body.contains("Knoten 9"), "{}", sheet.body);
    assert!(pages.iter().all(|(_, page)| page.contains("lang=\"de\"") && page.contains("4711")), "{pages:?}");
    let missing = "Knoten 9 (panel): Das Gerät ist nicht am Bus.";
    assert!(pages.iter().all(|(_, page)| page.contains(missing)), "{pages:?}");
    // The adapter is that of the next start.
    assert_eq!(fs::read_to_string(folder.join("bus")).unwrap(), bus);
    assert_eq!(ui.finish(), None);
    let fakes = server.join().unwrap().0;
    assert_eq!(fakes.iter().map(|fake| !fake.blocks.is_empty()).collect::<Vec<_>>(), [true, false, false]);
    let (next, _server) = kit::fake::serve(Bus(vec![device(5, 1234).0]));
    fs::write(folder.join("bus"), format!("{next}\n")).unwrap();
    let ui = station(&folder, self::package(&folder, DRIVES), None);
    assert_eq!(ui.until("the adapter", |state| state["open"] == true)["adapter"], json!(next));
}

/// A device gets its first program, in a dialect without a trial, and the second one is refused before its first
/// frame (a lift without its password): each has its own outcome, and nothing is good that was not done.
#[test]
fn each_program_of_a_device_has_its_own_outcome() {
    let folder = kit::folder!("service-two");
    let programs = "[[program]]\nname = 'main'\nimage = 'app.hex'\nnodes = [5]\n\
                    [[program]]\nname = 'data'\nimage = 'app.hex'\nnodes = [5]\nprogram = 2\n\
                    trial-run = false\n";
    let (bus, _server) = kit::fake::serve(Bus(vec![device(5, 1234).0]));
    let ui = station(&folder, package(&folder, programs), Some(bus));
    let plan = planned(&ui);
    assert_eq!(confirm(&ui, &plan, &[5]).status, 200);
    let state = ended(&ui);
    let row = &state["rows"][0];
    assert_eq!((&state["says"], &row["left"]), (&json!("bad"), &json!("left-other")), "{state}");
    let states = [0, 1].map(|step: usize| row["steps"][step]["state"].as_str().unwrap());
    assert_eq!(states, ["state-updated", "state-failed"]);
    let table = &saved(&folder, "csv")[0].1;
    let lines: Vec<&str> = table.lines().skip(1).collect();
    assert!(lines[0].contains(",updated,,,J") && lines[1].contains(",failed,0x6"), "{table}");
    let sheet = ui.get("sheet").body;
    for (what, result) in [("ein zweites Mal", "2 von 2 gut"), ("Probelauf", "1 von 1 gut")] {
        let line = sheet.lines().find(|line| line.contains(what)).unwrap();
        assert!(line.contains(&format!("<td>{result}</td></tr>")), "{line}");
    }
    assert!(sheet.contains("Knoten 5 · data</h3>"), "{sheet}");
}

/// The device has V1.10r101, and the file is V1.10r100 (expected.py): it is written if the user chooses it, and not
/// before. Of another machine that is said once, without a word at its devices.
#[test]
fn an_older_program_is_a_choice_and_another_machine_is_said_once() {
    for product in [1234, 1235] {
        let folder = kit::folder!(&format!("service-older-{product}"));
        fs::write(folder.join("a.blk"), include_bytes!("../../../core/tests/data/release-110.blk")).unwrap();
        let recipe =
            "[[program]]\nname = 'drive'\nimage = 'a.blk'\nnodes = [5]\nvendor = 63\nproduct = 1234\n";
        let (mut fake, serial) = device(5, product);
        fake.maker = Some(Box::new(Plate { product, serial, version: 0x0065_0A01 }));
        let (bus, server) = kit::fake::serve(Bus(vec![fake]));
        let ui = station(&folder, package(&folder, recipe), Some(bus));
        let plan = planned(&ui);
        if product == 1235 {
            assert_eq!((&plan["station"], rows(&plan)), (&json!("other-machine"), vec![(5, "state-failed")]));
            assert_eq!(plan["rows"][0]["trouble"], Value::Null);
            assert_eq!(confirm(&ui, &plan, &[5]).status, 400);
        } else {
            assert_eq!((&plan["station"], rows(&plan)), (&json!("planned"), vec![(5, "state-older")]));
            assert_eq!(confirm(&ui, &plan, &[]).status, 200);
            assert_eq!(rows(&ended(&ui)), [(5, "state-left-out")]);
            let plan = planned(&ui);
            assert_eq!(confirm(&ui, &plan, &[5]).status, 200);
            assert_eq!(rows(&ended(&ui)), [(5, "state-updated")]);
        }
        assert_eq!(ui.finish(), None);
        assert_eq!(server.join().unwrap().0[0].blocks.is_empty(), product == 1235);
    }
}

/// One device has its program, the other one is missing: nothing was updated or was to be.
#[test]
fn a_search_alone_speaks_of_no_update() {
    let folder = kit::folder!("service-incomplete");
    let package = package(&folder, DRIVES);
    let (mut has, _) = device(6, 1234);
    has.crc_of_application = Some(package.programs().next().unwrap().1.crc());
    let (bus, _server) = kit::fake::serve(Bus(vec![has]));
    let ui = station(&folder, package, Some(bus));
    let plan = planned(&ui);
    assert_eq!(rows(&plan), [(6, "state-has"), (5, "state-failed")]);
    assert_eq!((&plan["station"], &plan["hint"]), (&json!("planned-bad"), &json!("hint-incomplete")));
}

/// Somebody puts another device to the node while the plan is on the screen.
#[test]
fn a_device_that_is_exchanged_in_mid_plan_gets_nothing() {
    let folder = kit::folder!("service-exchanged");
    let (five, serial) = device(5, 1234);
    let (ui, server) = drives(&folder, vec![five, device(6, 1234).0]);
    let plan = planned(&ui);
    assert_eq!(plan["station"], "planned");
    *serial.lock().unwrap() = 4711;
    assert_eq!(confirm(&ui, &plan, &[5, 6]).status, 200);
    let state = ended(&ui);
    assert_eq!(rows(&state), [(5, "state-failed"), (6, "state-updated")]);
    assert_eq!(state["rows"][0]["trouble"]["key"], "trouble-exchanged");
    let reports = saved(&folder, "csv");
    assert!(reports[0].1.contains("0x6000040C") && reports[1].1.contains(",updated,6,"), "{reports:?}");
    ui.finish();
    let fakes = server.join().unwrap().0;
    assert!(fakes[0].blocks.is_empty() && !fakes[1].blocks.is_empty());
}

/// A second station of this computer holds its nodes, and one of another computer is heard on the bus.
#[test]
fn a_second_station_is_waited_for() {
    let folder = kit::folder!("service-second");
    let (bus, _server) = kit::fake::serve(Bus(vec![device(5, 1234).0, device(6, 1234).0]));
    let ui = station(&folder, package(&folder, DRIVES), Some(bus.clone()));
    ui.until("the adapter", |state| state["open"] == true);
    let refused = |ui: &Ui| {
        assert_eq!(ui.post("search", &json!({})).status, 200);
        let state = refusal(ui);
        assert_eq!(state["message"]["key"], "trouble-not-alone", "{state}");
        assert_eq!((&state["message"]["number"], &state["plan"]), (&json!(0x6000_0012), &Value::Null));
    };
    let held = Lock::of(&bus, NodeId::new(6).unwrap()).unwrap();
    refused(&ui);
    drop(held);
    let plan = planned(&ui);
    assert!(plan["message"].is_null(), "{plan}");
    // It begins when this plan is on the screen: the plan stays, and can be confirmed when the other one is done.
    let held = Lock::of(&bus, NodeId::new(5).unwrap()).unwrap();
    assert_eq!(confirm(&ui, &plan, &[5]).status, 200);
    let state = refusal(&ui);
    assert_eq!((&state["message"]["key"], &state["plan"]), (&json!("trouble-not-alone"), &plan["plan"]));
    drop(held);
    assert_eq!(confirm(&ui, &plan, &[5]).status, 200);
    assert_eq!(rows(&ended(&ui)), [(5, "state-updated"), (6, "state-left-out")]);
    assert_eq!(saved(&folder, "csv").len(), 1);

    let mut noisy = device(5, 1234).0;
    for number in 0..3000 {
        // A read of 1F57h/1 by somebody else.
        let id = StandardId::new(0x600 + 77).unwrap();
        let request = Frame::new(id, &[0x40, 0x57, 0x1F, 1, 0, 0, 0, 0]).unwrap();
        noisy.later(Duration::from_millis(40) * number, request);
    }
    let (ui, server) = drives(&folder, vec![noisy]);
    ui.until("the adapter", |state| state["open"] == true);
    refused(&ui);
    ui.finish();
    assert!(server.join().unwrap().0[0].log.is_empty(), "nobody was asked");
}

/// A file in the place of the folder is as good as a full disk, also for root.
#[test]
fn what_cannot_be_saved_is_kept_and_nothing_more_is_begun() {
    let folder = kit::folder!("service-full");
    let (ui, server) = drives(&folder, vec![device(5, 1234).0, device(6, 1234).0]);
    let plan = planned(&ui);
    let (reports, away) = (folder.join("reports"), folder.join("away"));
    fs::rename(&reports, &away).unwrap();
    fs::write(&reports, "").unwrap();
    assert_eq!(confirm(&ui, &plan, &[5, 6]).status, 200);
    let state = refusal(&ui);
    assert_eq!((&state["message"]["key"], &state["plan"]), (&json!("not-saved"), &plan["plan"]));
    assert_eq!(rows(&state), [(5, "state-due"), (6, "state-due")]);
    // The disk becomes full during the update.
    fs::remove_file(&reports).unwrap();
    fs::rename(&away, &reports).unwrap();
    assert_eq!(confirm(&ui, &plan, &[5]).status, 200);
    ui.until("the update", |state| state["rows"][0]["percent"].is_u64());
    fs::rename(&reports, &away).unwrap();
    fs::write(&reports, "").unwrap();
    let state = ended(&ui);
    assert_eq!((&state["station"], &state["unsaved"]), (&json!("good-unsaved"), &json!(2)));
    assert_eq!(state["why"]["key"], "not-saved");
    // A browser may save it, and it is still kept.
    let report = ui.get("report?number=0");
    assert!(report.status == 200 && report.body.contains("000003EDh"), "{}", report.body);
    assert!(report.head.contains("content-disposition: attachment"), "{}", report.head);
    assert_eq!(ui.get("report?number=2").status, 404);
    assert_eq!(ui.post("save", &json!({})).status, 200);
    assert_eq!(ui.until("still not saved", |_| true)["unsaved"], 2);
    // No other device is changed until it is saved, and a search does not lose it.
    let plan = planned(&ui);
    assert_eq!(confirm(&ui, &plan, &[6]).status, 200);
    let state = refusal(&ui);
    assert_eq!(state["unsaved"], 2);
    // The folder takes files again, but this report has no name there.
    fs::remove_file(&reports).unwrap();
    fs::rename(&away, &reports).unwrap();
    let date = report.head.split("filename=\"").nth(1).unwrap().split("z_node").next().unwrap();
    let name = format!("{date}Z_node-5_000003EDh");
    let taken = (2..=100).map(|count| format!("{name}_{count}.html")).chain([format!("{name}.html")]);
    let taken: Vec<PathBuf> = taken.map(|name| reports.join(name)).collect();
    taken.iter().for_each(|path| fs::write(path, "").unwrap());
    assert_eq!(confirm(&ui, &plan, &[6]).status, 200);
    let state = refusal(&ui);
    assert_eq!((&state["message"]["key"], &state["unsaved"]), (&json!("not-saved"), &json!(1)));
    assert_eq!(rows(&state), [(5, "state-due"), (6, "state-due")]);
    // The end of the server says what is lost with it.
    let said = ui.finish().expect("a report is not saved");
    assert!(["could not be saved", "000003EDh", "4711"].iter().all(|words| said.contains(words)), "{said}");
    let fakes = server.join().unwrap().0;
    assert!(!fakes[0].blocks.is_empty() && fakes[1].blocks.is_empty());
}

/// The end of the server in mid-update: the outcome is saved.
#[test]
fn the_end_of_the_server_saves_the_outcome() {
    let folder = kit::folder!("service-end");
    let (mut five, _) = device(5, 1234);
    five.erase_time = Duration::from_secs(3600);
    let (ui, _server) = drives(&folder, vec![five, device(6, 1234).0]);
    let plan = planned(&ui);
    assert_eq!(confirm(&ui, &plan, &[5]).status, 200);
    ui.until("the update", |state| state["rows"][0]["state"] == "state-working");
    // What has begun is there already: a computer that loses its power leaves this.
    let [(name, begun)] = &saved(&folder, "csv")[..] else { panic!("one report") };
    assert!(name.ends_with("Z_node-5_000003EDh_begun.csv") && begun.contains(",begun,5,"), "{name}: {begun}");
    let words = ui.finish().expect("an update was running");
    assert!(words.starts_with("an update was running: node 5: cancelled"), "{words}");
    let reports = saved(&folder, "csv");
    assert!(reports.len() == 1 && reports[0].1.contains(",failed,5,"), "{reports:?}");

    // As after a loss of power in the update of node 5, which had its program by then; node 6 is as
    // before.
    fs::remove_file(folder.join("reports").join(&reports[0].0)).unwrap();
    fs::write(folder.join("reports").join(name), begun).unwrap();
    let package = package(&folder, DRIVES);
    let mut has = device(5, 1234).0;
    has.crc_of_application = Some(package.programs().next().unwrap().1.crc());
    let (bus, _server) = kit::fake::serve(Bus(vec![has, device(6, 1234).0]));
    let ui = station(&folder, package, Some(bus));
    let plan = planned(&ui);
    assert_eq!(rows(&plan), [(5, "state-has"), (6, "state-due")]);
    assert_eq!(confirm(&ui, &plan, &[6]).status, 200);
    ended(&ui);
    let reports = saved(&folder, "csv");
    let [(old, _), (_, five), (_, six)] = &reports[..] else { panic!("{reports:?}") };
    assert!(old == name && five.contains(",resumed,5,") && six.contains(",updated,6,"), "{five}{six}");
    let pages = saved(&folder, "html");
    let fact = format!("<th>Unterbrochenes Update</th><td>{name}</td>");
    assert!(pages.iter().any(|(_, page)| page.contains(&fact)), "{pages:?}");
}

/// What only a log could say of a device that fails, for the report of the run.
#[test]
fn what_a_failed_device_has_shown_is_reported() {
    let folder = kit::folder!("service-shown");
    let mut five = device(5, 1234).0;
    five.on_block = Box::new(|_| Outcome::Status(0x06));
    let (bus, _server) = kit::fake::serve(Bus(vec![five, device(6, 1234).0]));
    let (drives, reports) = (package(&folder, DRIVES), folder.join("reports"));
    let service = Service::new(drives, "press.cpk".as_ref(), Origin::Package, &reports).unwrap();
    let reported: Arc<Mutex<Vec<FailedUpdate>>> = Arc::default();
    let report = reported.clone();
    let ui = Ui::with(|options| {
        (options.bus, options.service) = (Some(bus), Some(service));
        options.failed = Failed::new(move |update| report.lock().unwrap().push(update.clone()));
    });
    let plan = planned(&ui);
    assert_eq!(confirm(&ui, &plan, &[5, 6]).status, 200);
    let state = ended(&ui);
    assert_eq!(rows(&state), [(5, "state-failed"), (6, "state-updated")]);
    assert_eq!((&state["says"], &state["rows"][0]["left"]), (&json!("bad-empty"), &json!("left-none")));
    // Then the device is not there. What is known of it stays, for page and report.
    let (next, _server) = kit::fake::serve(Bus(vec![device(6, 1234).0]));
    assert_eq!(ui.post("open", &json!({ "url": next })).status, 200);
    ui.until("the other bus", |state| state["adapter"] == *next && state["open"] == true);
    let plan = planned(&ui);
    let row = &plan["rows"][1];
    assert_eq!((&row["says"], &row["left"]), (&json!("state-empty"), &json!("left-none")));
    assert_eq!(confirm(&ui, &plan, &[6]).status, 200);
    assert_eq!(ended(&ui)["says"], "bad-empty");
    // Of the next machine nothing is known.
    let (other, serial) = device(6, 1234);
    *serial.lock().unwrap() = 2006;
    let (next, _server) = kit::fake::serve(Bus(vec![other]));
    assert_eq!(ui.post("open", &json!({ "url": next })).status, 200);
    ui.until("the bus of the next machine", |state| state["adapter"] == *next && state["open"] == true);
    assert_ne!(planned(&ui)["rows"][1]["says"], "state-empty");
    let is_told =
        |(name, page): &&(String, String)| name.contains("node-5") && page.contains("kein Programm.");
    assert_eq!(saved(&folder, "html").iter().filter(is_told).count(), 2);
    let reported = reported.lock().unwrap();
    assert!(!reported.is_empty() && reported.iter().all(|failed| failed.node.get() == 5), "{reported:?}");
    // CiA 302-3: the error 3 in bits 1 to 7 of 1F57h.
    let failed = &reported[0];
    assert!(failed.answers.iter().any(|line| line.starts_with("1F57h reads 06h")), "{failed:?}");
    assert!(!failed.tried.is_empty() && !failed.frames.is_empty(), "{failed:?}");
}

/// The page asks for the password of a locked device; it is in no state, no report and no message.
#[test]
fn a_locked_device_gets_its_password_from_the_page_and_nothing_keeps_it() {
    let folder = kit::folder!("service-password");
    let (fake, kept) = Lift::fake(APPLICATION, |_| {});
    let (bus, _server) = kit::fake::serve(fake);
    let programs = "[[program]]\nname = 'door'\nimage = 'app.hex'\nnodes = [5]\ndialect = 'lift'\n";
    let ui = station(&folder, package(&folder, programs), Some(bus));
    let mut seen = String::new();
    for (password, state, trouble) in [
        ("", "state-failed", Some("trouble-password")),
        ("PLANTED-wrong", "state-failed", Some("trouble-wrong-password")),
        (PHRASE, "state-updated", None),
    ] {
        let plan = planned(&ui);
        assert_eq!(plan["asks_password"], true, "{plan}");
        let mut order = confirmed(&plan, &[5]);
        order["password"] = password.into();
        let answer = ui.post("update", &order);
        assert_eq!(answer.status, 200, "{}", answer.body);
        let end = ended(&ui);
        assert_eq!(rows(&end), [(5, state)], "{end}");
        assert_eq!(end["rows"][0]["trouble"]["key"].as_str(), trouble, "{end}");
        seen += &end.to_string();
    }
    assert!(!kept.lock().unwrap().is_empty());
    let texts = saved(&folder, "html").into_iter().chain(saved(&folder, "csv"));
    seen.extend(texts.map(|(name, text)| name + &text));
    seen += &ui.get("station").body;
    for secret in [PHRASE, "PLANTED"] {
        assert!(!seen.contains(secret), "{seen}");
    }
    let mut order = confirmed(&planned(&ui), &[5]);
    order["password"] = "PLANTED".repeat(10).into();
    let refused = ui.post("update", &order);
    assert!(refused.status == 400 && !refused.body.contains("PLANTED"), "{}", refused.body);
}

/// A job file does what a package does.
#[test]
fn a_job_file_is_a_machine() {
    let folder = kit::folder!("service-job");
    let job = "[[program]]\nimage = 'app.hex'\nnodes = [5, 6]\n\
               [[program]]\nname = 'other'\nimage = 'app.hex'\nnodes = [7]\ntrial-run = false\n";
    let package = package(&folder, job);
    let entries: Vec<_> = package.programs().map(|(entry, _)| entry).collect();
    assert_eq!(
        (entries[0].name.as_str(), &entries[0].nodes[..], entries[0].trial_run),
        ("app", &[5, 6][..], true)
    );
    assert_eq!((&entries[1].nodes[..], entries[1].trial_run), (&[7][..], false));
    let (bus, _server) = kit::fake::serve(Bus([5, 6, 7].map(|node| device(node, 1234).0).into()));
    let service = Service::new(package, "press.toml".as_ref(), Origin::Job, &folder.join("reports")).unwrap();
    let ui = Ui::with(|options| (options.bus, options.service) = (Some(bus), Some(service)));
    let told = ui.get("station").json();
    assert_eq!((&told["package"]["kind"], &told["package"]["signature"]), (&json!("job-file"), &Value::Null));
    let plan = planned(&ui);
    assert_eq!(plan["asks_password"], false);
    assert_eq!(confirm(&ui, &plan, &[5, 6, 7]).status, 200);
    let end = ended(&ui);
    assert_eq!(rows(&end), [(5, "state-updated"), (6, "state-updated"), (7, "state-updated")], "{end}");
}
