//! The state machine in virtual time. What the server says is written from the public description
//! of the interface.

use serde_json::json;

use super::*;

const BASE: &str = "https://h:443/T/controller/v1/door";

fn seconds(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

fn rules() -> Rules {
    Rules {
        part: None,
        artifact: None,
        attempt: Attempt::Update,
        confirm: false,
        size_most: 1 << 20,
        poll: (seconds(10), seconds(3600)),
        backoff: (seconds(4), seconds(64)),
        progress: seconds(5),
    }
}

/// A controller, and the time.
struct Drive {
    controller: Controller,
    now: Duration,
    /// What was written last, as another agent would read it.
    disk: Record,
}

impl Drive {
    fn new() -> Self {
        Self::with(rules(), Record::new(BASE))
    }

    fn with(rules: Rules, record: Record) -> Self {
        let controller = Controller::new("door", rules, record.clone(), 1);
        Self { controller, now: Duration::ZERO, disk: record }
    }

    /// The same device with an agent that was started again.
    fn restarted(&self) -> Self {
        Self::with(self.controller.rules.clone(), self.disk.clone())
    }

    /// The next step; time goes on as it must, and the record is written.
    fn next(&mut self) -> Step {
        loop {
            match self.controller.next(self.now) {
                Step::Wait(until) => {
                    assert!(until > self.now, "no time goes by");
                    self.now = until;
                }
                Step::Save(record) => {
                    self.disk = record;
                    self.controller.saved(self.now, Ok(()));
                }
                step => return step,
            }
        }
    }

    /// The next step is a request.
    #[track_caller]
    fn asks(&mut self) -> Request {
        match self.next() {
            Step::Ask(request) => request,
            step => panic!("{step:?}"),
        }
    }

    fn answer(&mut self, status: u16, body: &Value) {
        let reply = Reply { status, retry_after: None, body: body.to_string().into_bytes() };
        self.controller.answered(self.now, Ok(reply));
    }

    /// The next step is a poll, which gets these links.
    #[track_caller]
    fn poll(&mut self, links: &[(&str, &str)]) {
        assert_eq!(self.asks(), Request::Get(String::new()));
        let links: serde_json::Map<String, Value> =
            links.iter().map(|(name, href)| ((*name).to_string(), json!({ "href": href }))).collect();
        self.answer(200, &json!({ "config": { "polling": { "sleep": "00:01:00" } }, "_links": links }));
    }

    /// The next two steps are a poll and the deployment.
    #[track_caller]
    fn deploy(&mut self, deployment: &Value) {
        self.poll(&[("deploymentBase", "/d")]);
        assert_eq!(self.asks(), Request::Get("/d".into()));
        self.answer(200, deployment);
    }

    /// The next step is feedback; returns its path, its execution and its result.
    #[track_caller]
    fn feedback(&mut self) -> (String, String, String) {
        let Request::Post(path, body) = self.asks() else { panic!("no feedback") };
        self.answer(200, &json!({}));
        let word = |value: &Value| value.as_str().unwrap_or_default().to_string();
        let status = &body["status"];
        (path, word(&status["execution"]), word(&status["result"]["finished"]))
    }

    /// A deployment that is fetched.
    #[track_caller]
    fn fetch(&mut self, deployment: &Value) {
        self.deploy(deployment);
        self.feedback();
        assert!(matches!(self.next(), Step::Fetch(_)));
        self.controller.fetched(self.now, Piece::Whole);
    }

    /// From the first poll to the order to flash.
    #[track_caller]
    fn go_to_flash(&mut self) -> Flash {
        self.deploy(&deployment("8", "forced"));
        assert_eq!(self.feedback(), feedback("deploymentBase/8", "download", "none"));
        let Step::Fetch(wanted) = self.next() else { panic!("no download") };
        assert_eq!((wanted.size, wanted.link.as_str()), (1000, "/a.blk"));
        self.controller.fetched(self.now, Piece::Whole);
        // What the server wants is asked once more before the device is changed.
        self.deploy(&deployment("8", "forced"));
        let Step::Flash(flash) = self.next() else { panic!("it is not flashed") };
        flash
    }

    fn says(&mut self, words: &str) -> bool {
        self.controller.said().iter().any(|said| said.text.contains(words))
    }
}

fn feedback(of: &str, execution: &str, finished: &str) -> (String, String, String) {
    (format!("{of}/feedback"), execution.to_string(), finished.to_string())
}

fn deployment(action: &str, update: &str) -> Value {
    json!({ "id": action, "deployment": { "download": "forced", "update": update, "chunks": [{
        "part": "bApp", "version": "1", "name": "door", "artifacts": [artifact("a.blk")],
    }]}})
}

fn artifact(name: &str) -> Value {
    json!({
        "filename": name, "size": 1000, "hashes": { "sha256": "5".repeat(64) },
        "_links": { "download": { "href": format!("/{name}") } },
    })
}

#[test]
fn a_deployment_is_fetched_flashed_and_reported_once() {
    let mut drive = Drive::new();
    let flash = drive.go_to_flash();
    assert!(!flash.kept);
    assert!(drive.disk.has_begun("8"), "the record is written before the device is changed");
    drive.controller.flashed(drive.now, Flashed::Done(vec!["done".into()]));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "success"));
    assert!(drive.disk.finish_of("8").unwrap().ok && drive.disk.begun.is_none());
    // Then the next poll, at once: there may be more to do. After it the pause that the server
    // wants, and up to a tenth more.
    let before = drive.now;
    drive.poll(&[]);
    assert_eq!(drive.now, before);
    drive.poll(&[]);
    let pause = drive.now - before;
    assert!(pause >= seconds(60) && pause <= seconds(66), "{pause:?}");
    assert!(drive.disk.finish_of("8").unwrap().reported);
    assert!(drive.controller.is_settled(drive.now));
}

#[test]
fn the_same_action_again_is_reported_and_not_flashed_even_after_a_restart() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    drive.controller.flashed(drive.now, Flashed::Failed(vec!["node 5 does not answer".into()]));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "failure"));
    drive.deploy(&deployment("8", "forced"));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "failure"));
    let mut drive = drive.restarted();
    drive.deploy(&deployment("8", "forced"));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "failure"));
    // Without a pause the two would talk to each other for ever.
    let before = drive.now;
    drive.poll(&[]);
    assert!(drive.now - before >= seconds(59));
}

#[test]
fn a_result_that_the_server_did_not_take_is_reported_until_it_does() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    drive.controller.flashed(drive.now, Flashed::Done(vec![]));
    for _ in 0..3 {
        assert!(matches!(drive.asks(), Request::Post(path, _) if path == "deploymentBase/8/feedback"));
        drive.answer(500, &json!({}));
    }
    // The agent ends in between.
    let mut drive = drive.restarted();
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "success"));
    // A server that has closed the action is content, too.
    let mut drive = Drive::new();
    drive.go_to_flash();
    drive.controller.flashed(drive.now, Flashed::Done(vec![]));
    drive.asks();
    drive.answer(410, &json!({}));
    drive.poll(&[]);
}

#[test]
fn what_a_restart_interrupted_goes_on_whatever_the_window() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    let mut drive = drive.restarted();
    drive.deploy(&deployment("8", "skip"));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "resumed", "none"));
    assert!(matches!(drive.next(), Step::Fetch(_)));
    drive.controller.fetched(drive.now, Piece::Whole);
    drive.deploy(&deployment("8", "skip"));
    let Step::Flash(flash) = drive.next() else { panic!() };
    assert!(!flash.kept);
    // The device has got so far that it keeps the program: the next agent may find it running.
    drive.controller.news(News::Kept);
    assert!(
        matches!(drive.controller.next(drive.now), Step::Save(record) if record.begun.as_ref().unwrap().kept)
    );
    drive.next();
    let mut drive = drive.restarted();
    drive.fetch(&deployment("8", "forced"));
    drive.deploy(&deployment("8", "forced"));
    assert!(matches!(drive.next(), Step::Flash(flash) if flash.kept));
    // If the server wants it no more, the people must know.
    let mut drive = drive.restarted();
    drive.poll(&[]);
    drive.poll(&[]);
    assert!(drive.says("may be without a program"));
    assert_eq!(drive.disk.begun, None);
}

#[test]
fn a_cancellation_is_accepted_until_the_device_is_changed() {
    let cancel = json!({ "id": "11", "cancelAction": { "stopId": "8" } });
    let cancelled = |drive: &mut Drive| {
        drive.poll(&[("cancelAction", "/c")]);
        assert_eq!(drive.asks(), Request::Get("/c".into()));
        drive.answer(200, &cancel);
        drive.feedback()
    };
    let (accepted, rejected) =
        (feedback("cancelAction/11", "closed", "success"), feedback("cancelAction/11", "rejected", "none"));
    // Before anything was known of it.
    assert_eq!(cancelled(&mut Drive::new()), accepted);
    // While the file is fetched, and when it is there.
    let mut drive = Drive::new();
    drive.fetch(&deployment("8", "forced"));
    assert_eq!(cancelled(&mut drive), accepted);
    drive.poll(&[]);
    assert!(drive.controller.is_settled(drive.now));
    // While the device is flashed, even by the agent before this one.
    let mut drive = Drive::new();
    drive.go_to_flash();
    assert_eq!(cancelled(&mut drive), rejected);
    assert_eq!(cancelled(&mut drive.restarted()), rejected);
    // And the update goes on to its end.
    drive.controller.flashed(drive.now, Flashed::Done(vec![]));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "success"));
    assert_eq!(cancelled(&mut drive), rejected);
}

/// The poll still knows a deployment that is gone by the time it is read.
#[test]
fn a_deployment_that_is_gone_when_the_file_is_there_is_not_flashed() {
    let mut drive = Drive::new();
    drive.fetch(&deployment("8", "forced"));
    drive.poll(&[("deploymentBase", "/d")]);
    assert_eq!(drive.asks(), Request::Get("/d".into()));
    drive.answer(404, &json!({}));
    drive.poll(&[]);
    drive.poll(&[]);
    assert!(drive.disk.begun.is_none());
}

#[test]
fn a_held_deployment_is_fetched_and_waits() {
    let mut window = deployment("8", "forced");
    window["deployment"]["maintenanceWindow"] = "unavailable".into();
    let hold = Rules { attempt: Attempt::Hold, ..rules() };
    for (rules, held) in
        [(rules(), deployment("8", "skip")), (rules(), window), (hold, deployment("8", "attempt"))]
    {
        let mut drive = Drive::with(rules, Record::new(BASE));
        drive.fetch(&held);
        drive.deploy(&held);
        assert_eq!(drive.feedback(), feedback("deploymentBase/8", "downloaded", "none"), "{held}");
        assert!(drive.controller.is_settled(drive.now));
        // The server gets one report.
        drive.deploy(&held);
        drive.deploy(&deployment("8", "forced"));
        assert!(matches!(drive.next(), Step::Flash(_)), "{held}");
    }
    let mut drive = Drive::new();
    drive.fetch(&deployment("8", "attempt"));
    drive.deploy(&deployment("8", "attempt"));
    assert!(matches!(drive.next(), Step::Flash(_)), "by default what is not forced is done, too");
    // A deployment that is not even to be fetched.
    let mut skip = deployment("9", "skip");
    skip["deployment"]["download"] = "skip".into();
    let mut drive = Drive::new();
    drive.deploy(&skip);
    drive.feedback();
    drive.deploy(&skip);
    drive.poll(&[]);
    assert!(drive.says("withdrawn"));
}

#[test]
fn only_a_file_that_is_meant_and_can_be_checked_is_fetched() {
    let with = |artifacts: Value| {
        let mut deployment = deployment("8", "forced");
        deployment["deployment"]["chunks"][0]["artifacts"] = artifacts;
        deployment
    };
    let without = |key: &str| {
        let mut artifact = artifact("a.blk");
        artifact[key] = json!({});
        with(json!([artifact]))
    };
    let sized = |size: u64| {
        let mut artifact = artifact("a.blk");
        artifact["size"] = size.into();
        with(json!([artifact]))
    };
    for (deployment, words) in [
        (with(json!([])), "no file for this device"),
        (with(json!([artifact("a.blk"), artifact("b.blk")])), "several files (a.blk, b.blk)"),
        (without("hashes"), "no SHA-256"),
        (without("_links"), "no link"),
        (sized(0), "no firmware file"),
        (sized((1 << 20) + 1), "no firmware file"),
    ] {
        let mut drive = Drive::new();
        drive.deploy(&deployment);
        assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "failure"));
        assert!(drive.says(words), "{words}");
    }
    let mut other = deployment("8", "forced");
    let chunks = other["deployment"]["chunks"].as_array_mut().unwrap();
    chunks.push(json!({ "part": "os", "artifacts": [artifact("linux.img"), artifact("b.blk")] }));
    let rules = Rules { part: Some("os".into()), artifact: Some(".blk".into()), ..rules() };
    let mut drive = Drive::with(rules, Record::new(BASE));
    drive.deploy(&other);
    drive.feedback();
    assert!(matches!(drive.next(), Step::Fetch(wanted) if wanted.name == "b.blk"));
}

#[test]
fn a_server_that_lies_is_asked_once_more_and_nothing_is_flashed() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    for (mut drive, begun) in [(Drive::new(), false), (drive.restarted(), true)] {
        drive.deploy(&deployment("8", "forced"));
        drive.feedback();
        assert!(matches!(drive.next(), Step::Fetch(_)));
        drive.controller.fetched(drive.now, Piece::Wrong("its SHA-256 is another".into()));
        assert!(matches!(drive.next(), Step::Fetch(_)));
        drive.controller.fetched(drive.now, Piece::Wrong("its SHA-256 is another".into()));
        let Request::Post(_, body) = drive.asks() else { panic!() };
        assert_eq!(body["status"]["result"]["finished"], "failure");
        assert!(body["status"]["details"][0].as_str().unwrap().contains("was not flashed"), "{body}");
        assert_eq!(body["status"]["details"][1] == BEGUN_EARLIER, begun, "{body}");
        assert!(drive.disk.begun.is_none());
    }
    // A file that is found bad later, and the failure of a first attempt, which asks the device.
    for (begun, last) in [(drive.restarted(), BEGUN_EARLIER), (Drive::new(), "bad")] {
        let mut drive = begun;
        drive.fetch(&deployment("8", "forced"));
        drive.deploy(&deployment("8", "forced"));
        assert!(matches!(drive.next(), Step::Flash(_)));
        drive.controller.flashed(drive.now, Flashed::Failed(vec!["bad".into()]));
        assert!(drive.says(last));
    }
}

#[test]
fn a_download_that_breaks_off_goes_on_and_one_that_never_begins_ends() {
    let mut drive = Drive::new();
    drive.deploy(&deployment("8", "forced"));
    drive.feedback();
    let cut = |at, retry_after| Piece::Cut { at, why: "cut".into(), retry_after };
    let next = |drive: &mut Drive| loop {
        match drive.next() {
            Step::Fetch(_) => return true,
            Step::Ask(Request::Get(link)) if link.is_empty() => {
                let links = json!({ "deploymentBase": { "href": "/d" } });
                drive.answer(200, &json!({ "_links": links }));
            }
            Step::Ask(Request::Get(_)) => drive.answer(200, &deployment("8", "forced")),
            _ => return false,
        }
    };
    for at in 1..100 {
        assert!(next(&mut drive));
        drive.controller.fetched(drive.now, cut(at, None));
    }
    assert!(next(&mut drive));
    let before = drive.now;
    drive.controller.fetched(drive.now, cut(100, Some(seconds(600))));
    assert!(next(&mut drive));
    assert!(drive.now - before >= seconds(600), "Retry-After counts");
    let mut attempts = 0;
    while next(&mut drive) {
        attempts += 1;
        // A server that knows no parts begins anew each time: what it sends again is no progress.
        let piece = if attempts % 2 == 0 { cut(attempts, None) } else { Piece::More { at: 99 } };
        drive.controller.fetched(drive.now, piece);
        assert!(attempts < 50);
    }
    assert!(drive.says("cannot be fetched"));
}

#[test]
fn trouble_with_the_server_makes_pauses_that_grow_to_their_limit() {
    let mut drive = Drive::new();
    let status = |status| Ok(Reply { status, retry_after: None, body: vec![] });
    let answers = [
        Err("there is no connection".to_string()),
        Ok(Reply { status: 200, retry_after: None, body: b"<html>".to_vec() }),
        status(500),
        status(503),
        status(429),
        status(401),
        status(404),
    ];
    let mut before = Duration::ZERO;
    for (count, answer) in answers.into_iter().enumerate() {
        assert_eq!(drive.asks(), Request::Get(String::new()));
        if count > 0 {
            let (pause, full) = (drive.now - before, seconds(2 << count).min(seconds(64)));
            assert!(pause >= full / 2 && pause <= full, "{count}: {pause:?}");
        }
        before = drive.now;
        drive.controller.answered(drive.now, answer);
    }
    // The server may ask for more, and for no more than an hour.
    for (asked, pause) in [(200, 200), (1_000_000, 3600)] {
        drive.asks();
        let before = drive.now;
        let reply = Reply { status: 503, retry_after: Some(seconds(asked)), body: vec![] };
        drive.controller.answered(drive.now, Ok(reply));
        drive.poll(&[]);
        assert_eq!(drive.now - before, seconds(pause));
    }
    assert_eq!(drive.controller.failures(), 0);
}

#[test]
fn a_pause_that_the_server_asks_for_is_kept_within_its_limits() {
    for (sleep, least, most) in [
        ("00:00:00", 10, 11),
        ("23:59:59", 3600, 3960),
        ("00:02:00", 120, 132),
        ("PT2M", 120, 132),
        ("P1DT2H", 3600, 3960),
        ("PT36H", 3600, 3960),
        ("PT0.5S", 10, 11),
    ] {
        let mut drive = Drive::new();
        drive.asks();
        drive.answer(200, &json!({ "config": { "polling": { "sleep": sleep } } }));
        drive.asks();
        assert!(drive.now >= seconds(least) && drive.now <= seconds(most), "{sleep}: {:?}", drive.now);
        assert!(!drive.says("pause"), "{sleep}");
    }
}

/// The default is hawkBit's own, 5 minutes.
#[test]
fn a_pause_that_is_none_gets_the_default_and_is_said_once() {
    for sleep in [json!("-PT5M"), json!("PT"), json!("soon\u{1b}[2J"), json!(5), json!("x".repeat(100_000))] {
        let mut drive = Drive::new();
        drive.asks();
        let body = json!({ "config": { "polling": { "sleep": sleep } } });
        drive.answer(200, &body);
        drive.asks();
        assert!(drive.now >= seconds(300) && drive.now <= seconds(330), "{:?}", drive.now);
        let said = drive.controller.said();
        let [said] = said.as_slice() else { panic!("{said:?}") };
        assert!(said.text.contains("300 s") && said.text.contains("HH:MM:SS"), "{}", said.text);
        assert!(said.text.len() < 300 && !said.text.contains('\u{1b}'), "{}", said.text);
        drive.answer(200, &body);
        drive.asks();
        assert_eq!(drive.controller.said(), [], "it is the same value");
    }
}

/// Whatever a server gives, it is polled a few times in the pause that it asks for, and no more.
#[test]
fn a_new_action_at_each_poll_does_not_make_the_agent_spin() {
    let mut without_file = deployment("0", "forced");
    without_file["deployment"]["chunks"] = json!([]);
    for (fetched, flashed) in [(false, false), (true, false), (true, true)] {
        let mut drive = Drive::new();
        let (mut polls, mut actions) = (0, 0);
        for _ in 0..2000 {
            match drive.next() {
                Step::Ask(Request::Get(link)) if link.is_empty() => {
                    polls += 1;
                    let links = json!({ "deploymentBase": { "href": "/d" } });
                    let polling = json!({ "polling": { "sleep": "00:01:00" } });
                    drive.answer(200, &json!({ "config": polling, "_links": links }));
                }
                Step::Ask(Request::Get(_)) => {
                    // The same action twice in a row: the second time it is flashed.
                    let number = if flashed { actions / 2 } else { actions };
                    let given = if fetched { deployment("0", "forced") } else { without_file.clone() };
                    actions += 1;
                    let mut given = given;
                    given["id"] = number.to_string().into();
                    drive.answer(200, &given);
                }
                Step::Ask(_) => drive.answer(200, &json!({})),
                Step::Fetch(_) => drive.controller.fetched(drive.now, Piece::Whole),
                Step::Flash(_) => drive.controller.flashed(drive.now, Flashed::Done(vec![])),
                step => panic!("{step:?}"),
            }
        }
        let pauses = drive.now.as_secs() / 60;
        assert!(polls > 100 && polls <= 3 * (pauses + 1), "{polls} polls in {pauses} pauses");
    }
}

#[test]
fn progress_is_told_sparingly_and_the_device_waits_for_no_message() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    let began = drive.now;
    let mut messages = Vec::new();
    for percent in 0..=100 {
        drive.controller.news(News::Percent(percent));
        // A repetition begins at 0 again, and what was reached counts.
        drive.controller.news(News::Percent(0));
        // The device needs a quarter of a second for each percent.
        let until = drive.now + Duration::from_millis(250);
        loop {
            match drive.controller.next(drive.now) {
                Step::Wait(wait) if wait >= until => break,
                Step::Wait(wait) => drive.now = wait,
                Step::Ask(Request::Get(_)) => drive.answer(200, &json!({})),
                Step::Ask(Request::Post(_, body)) => {
                    messages.push((drive.now, body["status"]["result"]["progress"]["cnt"].as_u64().unwrap()));
                    // What gets lost is not sent again.
                    drive.answer(if messages.len() % 2 == 0 { 400 } else { 200 }, &json!({}));
                }
                step => panic!("{step:?}"),
            }
        }
        drive.now = until;
    }
    let sent: Vec<u64> = messages.iter().map(|(_, percent)| *percent).collect();
    assert_eq!(sent, [10, 30, 50, 70, 90], "each ten percent, and each five seconds");
    assert!(drive.now - began >= seconds(25));
    // Not even ten thousand phases make more than a hundred messages.
    for number in 0..10_000 {
        drive.controller.news(News::Phase(format!("phase {number}")));
        drive.now += seconds(6);
        while let Step::Ask(request) = drive.controller.next(drive.now) {
            messages.extend(matches!(request, Request::Post(..)).then_some((drive.now, 0)));
            drive.answer(200, &json!({}));
        }
    }
    assert_eq!(messages.len(), 100);
}

/// A plan that nothing follows would be lost, and with it what is left alone.
#[test]
fn what_was_not_told_before_the_end_is_told_with_it() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    for line in ["node 5: door: it has 1.0.0", "node 77: left alone"] {
        drive.controller.news(News::Phase(line.into()));
    }
    drive.controller.flashed(drive.now, Flashed::Done(vec!["door: had it before: node 5".into()]));
    let Request::Post(_, body) = drive.asks() else { panic!("no feedback") };
    assert_eq!(body["status"]["details"], json!(["node 5: door: it has 1.0.0", "node 77: left alone"]));
    drive.answer(200, &json!({}));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "closed", "success"));
}

/// A plan has more lines than a message.
#[test]
fn a_long_plan_is_told_in_several_messages() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    let plan: Vec<String> = (1..=120).map(|node| format!("node {node}: drive: it has 1.0.0")).collect();
    plan.iter().for_each(|line| drive.controller.news(News::Phase(line.clone())));
    let mut sent = Vec::new();
    let mut message = |drive: &mut Drive| {
        let Request::Post(_, body) = drive.asks() else { panic!("no feedback") };
        let lines = body["status"]["details"].as_array().unwrap();
        assert!(lines.len() <= 50, "hawkBit keeps 50");
        sent.extend(lines.iter().map(|line| line.as_str().unwrap().to_string()));
        drive.answer(200, &json!({}));
    };
    message(&mut drive);
    drive.controller.flashed(drive.now, Flashed::Done(vec!["drive: had it before".into(); 60]));
    message(&mut drive);
    message(&mut drive);
    assert_eq!(sent, plan);
    assert_eq!(drive.feedback(), self::feedback("deploymentBase/8", "closed", "success"));
    // The state file has the lines that the server gets.
    assert_eq!(drive.disk.ended.last().unwrap().details.len(), 50);
}

#[test]
fn a_bus_in_use_is_waited_for_and_the_update_may_be_cancelled_meanwhile() {
    let mut drive = Drive::new();
    drive.go_to_flash();
    let before = drive.now;
    drive.controller.flashed(drive.now, Flashed::NotNow("node 5: another coflash works on it".into()));
    assert_eq!(drive.feedback(), feedback("deploymentBase/8", "proceeding", "none"));
    assert!(drive.disk.begun.is_none(), "nothing was changed");
    assert!(matches!(drive.next(), Step::Flash(_)));
    assert!(drive.now - before >= seconds(2));
    drive.controller.flashed(drive.now, Flashed::NotNow("still".into()));
    drive.feedback();
    drive.controller.poll_at = drive.now;
    drive.poll(&[("cancelAction", "/c")]);
    drive.asks();
    drive.answer(200, &json!({ "id": "11", "cancelAction": { "stopId": "8" } }));
    assert_eq!(drive.feedback(), feedback("cancelAction/11", "closed", "success"));
    drive.poll(&[]);
}

#[test]
fn attributes_are_sent_when_the_server_asks_and_the_device_answers() {
    let mut drive = Drive::new();
    drive.poll(&[("configData", "/x")]);
    assert_eq!(drive.next(), Step::AskDevice);
    // The device takes its time: other steps go on, and it is not asked twice.
    drive.poll(&[("configData", "/x")]);
    drive.controller.device_answered(Err("node 5 does not answer".into()));
    drive.poll(&[("configData", "/x")]);
    assert_eq!(drive.next(), Step::AskDevice);
    drive.controller.device_answered(Ok(vec![("software".into(), "1.0.0".into())]));
    let Request::Put(path, body) = drive.asks() else { panic!() };
    assert_eq!((path.as_str(), &body["data"]["software"]), ("configData", &json!("1.0.0")));
    drive.answer(200, &json!({}));
    // Not while the device is flashed.
    let mut drive = Drive::new();
    drive.go_to_flash();
    drive.poll(&[("deploymentBase", "/d"), ("configData", "/x")]);
    drive.poll(&[("deploymentBase", "/d"), ("configData", "/x")]);
    drive.controller.flashed(drive.now, Flashed::Done(vec![]));
    assert!(matches!(drive.next(), Step::AskDevice | Step::Ask(_)));
}

#[test]
fn the_agent_confirms_only_if_it_is_told_to() {
    let link = [("confirmationBase", "https://h/T/controller/v1/door/confirmationBase/8?c=5")];
    let mut drive = Drive::with(Rules { confirm: true, ..rules() }, Record::new(BASE));
    drive.poll(&link);
    let Request::Post(path, body) = drive.asks() else { panic!() };
    assert_eq!((path.as_str(), &body["confirmation"]), ("confirmationBase/8/feedback", &json!("confirmed")));
    let mut drive = Drive::new();
    drive.poll(&link);
    drive.poll(&link);
}

#[test]
fn a_state_that_cannot_be_written_keeps_the_device_untouched() {
    let mut drive = Drive::new();
    drive.fetch(&deployment("8", "forced"));
    drive.deploy(&deployment("8", "forced"));
    for _ in 0..5 {
        let step = drive.controller.next(drive.now);
        assert!(matches!(step, Step::Save(_)), "{step:?}");
        drive.controller.saved(drive.now, Err("no room".into()));
        let Step::Wait(until) = drive.controller.next(drive.now) else { panic!() };
        drive.now = until;
    }
    assert!(drive.says("no room"));
    assert!(matches!(drive.next(), Step::Flash(_)));
}

/// What a server may answer to a request.
fn bodies(request: &Request) -> Vec<Value> {
    match request {
        Request::Get(link) if link == "/d" => vec![
            deployment("8", "forced"),
            deployment("8", "forced"),
            deployment("9", "attempt"),
            deployment("8", "skip"),
            json!({ "id": 11 }),
        ],
        Request::Get(link) if link == "/c" => {
            vec![json!({ "id": 11, "cancelAction": { "stopId": "8" } }), json!({})]
        }
        _ => vec![
            json!({}),
            json!({ "_links": { "deploymentBase": { "href": "/d" } } }),
            json!({ "_links": { "deploymentBase": { "href": "/d" }, "configData": { "href": "/x" } } }),
            json!({ "_links": { "cancelAction": { "href": "/c" } } }),
            json!([1, 2]),
        ],
    }
}

/// Whatever order things come in: it never waits without a time, never flashes what is not
/// in the record, and never more than one thing at once.
#[test]
fn no_course_of_answers_brings_it_out_of_step() {
    let mut jitter = Jitter::new(7);
    let pause = (seconds(2_000_000), seconds(2_000_000));
    let mut pick = move |of: usize| jitter.after(1, pause).as_micros() as usize % of;
    let statuses = [200, 200, 200, 200, 200, 200, 200, 200, 400, 401, 404, 410, 429, 500];
    let mut flashes = 0;
    for _ in 0..200 {
        let mut drive = Drive::new();
        let (mut flashing, mut looking) = (None, false);
        for _ in 0..200 {
            match drive.controller.next(drive.now) {
                Step::Wait(until) => {
                    assert!(until > drive.now);
                    drive.now = until;
                    match pick(4) {
                        0 if flashing.is_some() => {
                            let end = [
                                Flashed::Done(vec![]),
                                Flashed::Failed(vec![]),
                                Flashed::NotNow(String::new()),
                                Flashed::Interrupted,
                            ];
                            drive.controller.flashed(drive.now, end[pick(4)].clone());
                            flashing = None;
                        }
                        1 if flashing.is_some() => drive.controller.news(News::Kept),
                        2 if looking => {
                            drive.controller.device_answered(Ok(vec![]));
                            looking = false;
                        }
                        3 => drive = drive.restarted(),
                        _ => {}
                    }
                    if drive.now == Duration::ZERO {
                        (flashing, looking) = (None, false);
                    }
                }
                Step::Ask(request) => {
                    let bodies = bodies(&request);
                    drive.answer(statuses[pick(statuses.len())], &bodies[pick(bodies.len())]);
                }
                Step::Fetch(_) => {
                    let cut = Piece::Cut { at: pick(2) as u64, why: String::new(), retry_after: None };
                    let more = Piece::More { at: pick(9) as u64 };
                    let piece = [Piece::Whole, Piece::Whole, cut, Piece::Wrong(String::new()), more];
                    drive.controller.fetched(drive.now, piece[pick(5)].clone());
                }
                Step::Save(record) => {
                    let fails = pick(5) == 0;
                    if !fails {
                        drive.disk = record;
                    }
                    drive.controller.saved(drive.now, if fails { Err(String::new()) } else { Ok(()) });
                }
                Step::AskDevice => {
                    assert!(!looking);
                    looking = true;
                }
                Step::Flash(flash) => {
                    assert_eq!(flashing, None);
                    assert!(drive.disk.begun.is_some(), "not in the record");
                    flashing = Some(flash.wanted);
                    flashes += 1;
                }
            }
        }
    }
    assert!(flashes > 50, "{flashes}");
}
