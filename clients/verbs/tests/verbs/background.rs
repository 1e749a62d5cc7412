//! Tests of `background` with a fake hub that keeps only a model.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, chown};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::fake::{OutputFile, TestDomain};
use crate::{context, domain_options};
use scanhub_schema::{Background, BackgroundHead, Failure, Kind, Response, ResponseModel, Verb, as_json};
use scanhub_shm::ControlServer;
use scanhub_shm::{Domain, HubLock};
use scanhub_verbs::background::{BackgroundArgs, ModelRequest, saved_model};

/// A hub that answers only control requests for the background of `front`.
struct FakeControlServer {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl FakeControlServer {
    fn new(domain: &Domain, mut model: Box<Background>) -> FakeControlServer {
        let (stop, domain) = (Arc::new(AtomicBool::new(false)), domain.clone());
        let lock = HubLock::acquire(domain.root()).unwrap();
        let flag = stop.clone();
        let (ready, is_ready) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let server = ControlServer::create(&scanhub_shm::hub_node(&domain).unwrap()).unwrap();
            lock.report_ready().unwrap();
            ready.send(()).unwrap();
            while !flag.load(Ordering::Relaxed) {
                while let Some(incoming) = server.receive().unwrap() {
                    let request = incoming.request().expect("requests of this version");
                    let answer = match (request.sensor.as_str(), request.verb) {
                        ("front", Some(verb)) => apply_request(&mut model, verb, request.model),
                        (other, _) => Err(Failure::new(
                            Kind::NoTopic,
                            format!("the hub has no sensor {other}"),
                            "there are front",
                        )),
                    };
                    server
                        .respond(incoming, &Response(answer.map(|model| model.map(ResponseModel::from))))
                        .unwrap();
                }
                scanhub_shm::sleep(&[server.requests()], Duration::from_millis(5)).unwrap();
            }
        });
        is_ready.recv().unwrap();
        FakeControlServer { stop, thread: Some(thread) }
    }
}

impl Drop for FakeControlServer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn apply_request(
    model: &mut Box<Background>,
    verb: Verb,
    new_model: Option<Box<Background>>,
) -> Result<Option<Box<Background>>, Failure> {
    let generation = model.generation + 1;
    match (verb, new_model) {
        (Verb::Reset, _) => {
            model.ranges_mut().fill(Background::UNKNOWN);
            (model.generation, model.known_beams) = (generation, 0);
        }
        (Verb::Freeze, _) => model.flags = Background::FROZEN,
        (Verb::Thaw, _) => model.flags = 0,
        (Verb::Load, Some(expected))
            if (expected.count, expected.unit_um) != (model.count, model.unit_um) =>
        {
            let message = format!("front has {} beams, the model {}", model.count, expected.count);
            return Err(Failure::new(Kind::Configuration, message, "save one of this resolution"));
        }
        (Verb::Load, Some(expected)) => {
            *model = expected;
            model.generation = generation;
        }
        _ => return Ok(Some(model.clone())),
    }
    Ok(None)
}

fn model() -> Box<Background> {
    model_with_beams(181, 1.0)
}

fn model_with_beams(count: usize, step_deg: f64) -> Box<Background> {
    let head = BackgroundHead {
        first_angle: (-90_f64).to_radians(),
        step: step_deg.to_radians(),
        generation: 4,
        known_beams: 3,
        unit_um: 10_000,
        ..BackgroundHead::default()
    };
    let mut model = Background::of(head, &vec![Background::UNKNOWN; count]);
    model.ranges_mut()[..4].copy_from_slice(&[400, 0, Background::FAR, 120]);
    model
}

fn run_order(
    test_domain: &TestDomain,
    sensor: &str,
    request: ModelRequest,
    json: bool,
) -> (Result<(), Failure>, String) {
    let args = BackgroundArgs { sensor: sensor.into(), order: request };
    let (out, notes) = (OutputFile::new(), OutputFile::new());
    let end =
        args.run(&mut context(domain_options(test_domain), json, out.file(), notes.file(), Arc::default()));
    (end, out.text())
}

/// Returns a request to save the model to a new file.
fn save_order(file: &Path) -> ModelRequest {
    ModelRequest::Save { file: file.to_owned(), force: false }
}

fn load_order(file: &Path) -> ModelRequest {
    ModelRequest::Load { file: file.to_owned(), any_sensor: false }
}

#[test]
fn background_is_saved_reset_and_loaded_again() {
    let test_domain = TestDomain::new();
    let _keeper = FakeControlServer::new(&test_domain.domain, model());
    let file = test_domain.base.join("model.json");
    let say = |order| {
        let (end, out) = run_order(&test_domain, "front", order, false);
        assert_eq!(end, Ok(()));
        out
    };
    assert_eq!(say(ModelRequest::Show), "front: generation 4: 3 of 181 beams known, 1 far, in 10 mm\n");
    let saved = format!("front: 3 of 181 beams saved to {}\n", file.display());
    assert_eq!(say(save_order(&file)), saved);
    assert_eq!(say(ModelRequest::Freeze), "front: background frozen\n");
    assert!(say(ModelRequest::Show).ends_with(", frozen\n"));
    assert_eq!(say(ModelRequest::Thaw), "front: background learning resumed\n");
    assert_eq!(say(ModelRequest::Reset), "front: background reset\n");
    assert_eq!(say(ModelRequest::Show), "front: generation 5: 0 of 181 beams known, 0 far, in 10 mm\n");
    let loaded = saved_model(&file, "front", false, &mut &b""[..]).unwrap();
    assert_eq!(loaded, model());
    assert_eq!(say(load_order(&file)), "front: background loaded\n");
    let (end, out) = run_order(&test_domain, "front", ModelRequest::Show, true);
    assert_eq!(end, Ok(()));
    assert_eq!(
        out.split_at(160).0,
        r#"{"class":"background","sensor":"front","generation":6,"known_beams":3,"unit_mm":10,"count":181,"first_angle_deg":-90.0,"step_deg":1.0,"frozen":false,"ranges":[400,null,"#
            .split_at(160)
            .0
    );
    // The shown model is equal to a saved file.
    let (_, piped) = run_order(&test_domain, "front", save_order(Path::new("-")), false);
    assert_eq!(piped, out);
    assert!(saved_model("-".as_ref(), "front", false, &mut out.as_bytes()).is_ok());
    let (_, out) =
        run_order(&test_domain, "front", ModelRequest::Save { file: file.clone(), force: true }, true);
    assert_eq!(
        out,
        format!(
            "{{\"class\":\"saved\",\"sensor\":\"front\",\"file\":{:?},\"generation\":6,\"known_beams\":3,\"count\":181}}\n",
            file.display().to_string()
        )
    );
    let (_, out) = run_order(&test_domain, "front", ModelRequest::Thaw, true);
    assert_eq!(out, "{\"class\":\"control\",\"sensor\":\"front\",\"verb\":\"thaw\",\"outcome\":\"taken\"}\n");
}

#[test]
fn unsuitable_or_unreadable_models_are_refused() {
    let test_domain = TestDomain::new();
    let _keeper = FakeControlServer::new(&test_domain.domain, model_with_beams(361, 0.5));
    let file = test_domain.base.join("model.json");
    run_order(&test_domain, "front", save_order(&file), false).0.unwrap();

    let foreign = saved_model(&file, "rear", false, &mut &b""[..]).unwrap_err();
    let message = format!("{} is the background of front, not of rear", file.display());
    assert_eq!((foreign.kind, foreign.message), (Kind::Configuration, message));
    assert!(foreign.hint.contains("--any-sensor"));
    assert!(saved_model(&file, "rear", true, &mut &b""[..]).is_ok());

    // The hub rejects a model of another resolution, and reports its own.
    let other = test_domain.base.join("other.json");
    fs::write(&other, serde_json::to_vec(&as_json("front", &model())).unwrap()).unwrap();
    let refused = run_order(&test_domain, "front", load_order(&other), false).0.unwrap_err();
    assert_eq!(
        (refused.kind, refused.message.as_str()),
        (Kind::Configuration, "front has 361 beams, the model 181")
    );
    let unknown = run_order(&test_domain, "rear", ModelRequest::Show, false).0.unwrap_err();
    assert_eq!((unknown.kind, unknown.hint.as_str()), (Kind::NoTopic, "there are front"));
    assert_eq!(run_order(&test_domain, "Front", ModelRequest::Show, false).0.unwrap_err().kind, Kind::Usage);

    let text = fs::read(&file).unwrap();
    fs::write(&file, &text[..text.len() / 2]).unwrap();
    let cut = saved_model(&file, "front", false, &mut &b""[..]).unwrap_err();
    assert!(cut.kind == Kind::Input && cut.message.contains("cut short"), "{cut}");
    for unreadable in ["/dev/zero", "/nowhere/model.json", "/"] {
        let failure = saved_model(unreadable.as_ref(), "front", false, &mut &b""[..]).unwrap_err();
        assert!(failure.kind == Kind::Input && failure.message.contains(unreadable), "{failure}");
    }
}

#[test]
fn failed_save_leaves_no_partial_file() {
    let test_domain = TestDomain::new();
    let _keeper = FakeControlServer::new(&test_domain.domain, model());
    let save =
        |file: PathBuf| run_order(&test_domain, "front", ModelRequest::Save { file, force: true }, false);
    for impossible in ["/nowhere/model.json", "/"] {
        let (end, out) = save(impossible.into());
        let failure = end.unwrap_err();
        assert!(failure.kind == Kind::Output && failure.message.contains(impossible), "{failure}");
        assert_eq!(out, "");
    }
    let (file, link) = (test_domain.base.join("model.json"), test_domain.base.join("link"));
    fs::write(&file, "old").unwrap();
    std::os::unix::fs::symlink(&file, &link).unwrap();
    for refused in [link, "/dev/null".into()] {
        assert_eq!(save(refused).0.unwrap_err().kind, Kind::Output);
    }
    assert_eq!(fs::read(&file).unwrap(), b"old");
    save(file.clone()).0.unwrap();
    assert!(saved_model(&file, "front", false, &mut &b""[..]).is_ok());
    // Owner and permissions of a replaced file stay the same.
    let _ = chown(&file, Some(12_345), Some(12_345));
    fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
    let rights = || fs::metadata(&file).map(|found| (found.mode(), found.uid(), found.gid())).unwrap();
    let before = rights();
    save(file.clone()).0.unwrap();
    assert_eq!(rights(), before);
    let left: Vec<_> =
        fs::read_dir(&test_domain.base).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(left.iter().all(|name| !name.to_string_lossy().starts_with('.')), "{left:?}");
}

#[test]
fn existing_file_is_replaced_only_by_force() {
    let test_domain = TestDomain::new();
    let _keeper = FakeControlServer::new(&test_domain.domain, model());
    let file = test_domain.base.join("model.json");
    let save =
        |force| run_order(&test_domain, "front", ModelRequest::Save { file: file.clone(), force }, false).0;
    save(false).unwrap();
    fs::write(&file, "mine").unwrap();
    let failure = save(false).unwrap_err();
    assert_eq!((failure.kind, failure.hint.as_str()), (Kind::Output, "--force replaces it"));
    assert_eq!(fs::read(&file).unwrap(), b"mine");
    save(true).unwrap();
    assert!(saved_model(&file, "front", false, &mut &b""[..]).is_ok());
}

#[test]
fn empty_background_does_not_replace_a_saved_one() {
    let test_domain = TestDomain::new();
    let _keeper = FakeControlServer::new(&test_domain.domain, model());
    let file = test_domain.base.join("model.json");
    let say = |order| run_order(&test_domain, "front", order, false);
    say(save_order(&file)).0.unwrap();
    say(ModelRequest::Freeze).0.unwrap();
    let (_, out) = say(ModelRequest::Reset);
    let hint = "it is frozen: nothing is learned until `scanhub background front thaw`";
    assert_eq!(out, format!("front: background reset\n{hint}\n"));
    for to in [file.clone(), "-".into()] {
        let (end, out) = say(ModelRequest::Save { file: to, force: true });
        let failure = end.unwrap_err();
        assert_eq!(failure.message, "the background of front has no known beam yet");
        assert_eq!((failure.kind, out.as_str()), (Kind::Failed, ""));
    }
    assert_eq!(saved_model(&file, "front", false, &mut &b""[..]).unwrap().known_beams, 3);
}

#[test]
fn save_before_the_first_scan_is_an_error() {
    let test_domain = TestDomain::new();
    let _keeper = FakeControlServer::new(&test_domain.domain, Box::default());
    let file = test_domain.base.join("model.json");
    let failure = run_order(&test_domain, "front", save_order(&file), false).0.unwrap_err();
    assert_eq!((failure.kind, failure.message.as_str()), (Kind::Failed, "front has no background model yet"));
    assert!(!file.exists());
}
