//! Tests of three dimensions on the web page and in its channels: the messages of the channels equal the output of
//! `echo`, and the page shows sweeps from the side on request.

use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use scanhub_ros::{POINT_CLOUD, Value as Told, read};
use serde_json::Value;
use tungstenite::{Message, WebSocket};

use crate::browser::Appearance;
use crate::pages::commands_on;
use crate::testkit::{INT, Program, TestEnv, is_class, number, wait_until};
use crate::tilt::{NEAR_FLAG, TiltHub, end_cleanly, numbers};
use crate::tilted::{CLASSES, TOPICS, TiltedPublisher, hub, round_of};
use crate::web::{channels, connect_viewer, connect_viewer_with, subscribe, web};
use crate::web_channels::matches_schema;
use crate::web_page::{browse, freeze_page, save_screenshot};

/// Publishes a round, and returns its messages: an angle, a sweep, and the obstacles in it.
fn publish_round(publisher: &mut TiltedPublisher, viewer: &mut WebSocket<TcpStream>) -> [Vec<u8>; 3] {
    publisher.publish_round();
    let mut messages: [Option<Vec<u8>>; 3] = Default::default();
    while messages.iter().any(Option::is_none) {
        let Message::Binary(frame) = viewer.read().expect("an open connection") else { continue };
        let number = u32::from_le_bytes(frame[1..5].try_into().expect("four bytes"));
        messages[number as usize] = Some(frame[13..].to_vec());
    }
    messages.map(Option::unwrap_or_default)
}

/// Returns whether a point cloud has exactly the points of these lines, which belong to one sweep.
fn is_cloud(body: &[u8], lines: &[Value]) -> bool {
    let message = read(&POINT_CLOUD, body).expect("a PointCloud2");
    let byte = |value: &Told| if let Told::Number(byte) = value { *byte as u8 } else { panic!("a byte") };
    let bytes: Vec<u8> = message.sequence("data").expect("data").iter().map(byte).collect();
    let list = |key: &str| -> Vec<&Value> {
        lines.iter().flat_map(|line| line[key].as_array().expect("a list")).collect()
    };
    let (points, beams, classes) = (list("points"), list("beams"), list("classes"));
    let is_point = |(n, point): (usize, &[u8; 16])| {
        let axes = point.as_chunks::<4>().0.iter().take(3).map(|axis| f64::from(f32::from_le_bytes(*axis)));
        axes.zip(numbers(points[n])).all(|(axis, expected)| (axis - expected).abs() < 6e-4)
            && beams[n].as_u64() == Some(u16::from_le_bytes([point[12], point[13]]).into())
            && classes[n].as_u64() == Some(point[14].into())
    };
    let all = bytes.as_chunks::<16>().0;
    message.text("header.frame_id") == Some("base_link")
        && all.len() == points.len()
        && all.iter().enumerate().all(is_point)
}

/// Returns the value that an entity has for `key` in its metadata: a number or a boolean.
fn metadata(entity: &Value, key: &str) -> Value {
    let mut all = entity["metadata"].as_array().expect("a list").iter();
    let value = all.find(|one| one["key"] == key).and_then(|one| one["value"].as_str());
    serde_json::from_str(value.unwrap_or_else(|| panic!("no {key} in {entity}"))).expect("JSON")
}

/// Returns whether the boxes of `update` are the obstacles of this line.
fn are_obstacles(update: &Value, line: &Value) -> bool {
    let entities = update["entities"].as_array().expect("a list");
    let expected = line["obstacles"].as_array().expect("a list");
    let is_box = |(entity, one): (&Value, &Value)| {
        let cube = &entity["cubes"][0];
        let is_axis = |(n, axis): (usize, &str)| {
            let number = |value: &Value| value.as_f64().expect("a number");
            let (middle, size) = (number(&cube["pose"]["position"][axis]), number(&cube["size"][axis]));
            let ends = (number(&one["low_m"][n]), number(&one["high_m"][n]));
            (middle - size / 2.0 - ends.0).abs() < 6e-4 && (middle + size / 2.0 - ends.1).abs() < 6e-4
        };
        ["x", "y", "z"].into_iter().enumerate().all(is_axis)
            && metadata(entity, "points") == one["points"]
            && metadata(entity, "foreground") == one["foreground"]
            && metadata(entity, "near") == one["near"]
    };
    metadata(&entities[0], "sweep") == line["sweep"]
        && metadata(&entities[0], "complete") == line["complete"]
        && metadata(&entities[0], "unreliable") == line["unreliable"]
        && entities.len() == expected.len() + 1
        && entities[1..].iter().zip(expected).all(is_box)
}

#[test]
fn channels_of_mount_and_sweep_equal_output_of_echo() {
    for protocol in ["foxglove.sdk.v1", "foxglove.websocket.v1"] {
        let env = TestEnv::new();
        let _hub = hub(&env);
        let mut made = TiltedPublisher::start_publisher(&env);
        let mut echo = env.echo(&TOPICS);
        let (_server, host) = web(&env, &[]);
        let mut viewer = connect_viewer_with(&host, "/", None, protocol).expect("an accepted viewer");
        let advertised = channels(&mut viewer, ["/mount/tilt", "/room/cloud", "/room/obstacles"]);
        wait_until("a subscriber to obstacles", || env.subscribers("room/obstacles") == 2);
        let seldom = ["room/cloud", "mount/tilt"];
        assert_eq!(seldom.map(|topic| env.subscribers(topic)), [1, 1], "only echo may have subscribed");
        let expected: Vec<(u32, &Value)> =
            (0..).zip(advertised.iter().map(|channel| &channel["id"])).collect();
        subscribe(&mut viewer, &expected);
        wait_until("subscribers to all classes", || seldom.map(|topic| env.subscribers(topic)) == [2, 2]);
        let rounds: Vec<_> = (0..4).map(|_| publish_round(&mut made, &mut viewer)).collect();
        let is_last =
            |line: &Value, class| line["class"] == class && line["first"] != true && round_of(line) == 3;
        wait_until("the same classes in echo", || {
            CLASSES.iter().all(|class| echo.prints(|line| is_last(line, *class)))
        });
        let echo = echo.end(INT);
        let lines = |class: &str, of: u64| {
            echo.of_class(class).into_iter().filter(|line| round_of(line) == of).collect::<Vec<_>>()
        };
        let object = |body: &[u8], channel: &Value| {
            let object = serde_json::from_slice::<Value>(body).expect("JSON");
            let schema = serde_json::from_str(channel["schema"].as_str().expect("a string")).expect("JSON");
            assert!(matches_schema(&object, &schema), "{object}");
            object
        };
        for (number, [tilt, cloud, obstacles]) in (0..).zip(&rounds) {
            let (tilt, expected) = (object(tilt, &advertised[0]), &lines("tilt", number)[0]);
            let close = |key: &str| match (tilt[key].as_f64(), expected[key].as_f64()) {
                (Some(decoded), Some(printed)) => (decoded - printed).abs() < 1e-4,
                (decoded, printed) => decoded.is_none() && printed.is_none(),
            };
            assert!(close("angle_deg") && close("rate_deg_s"), "{tilt} {expected}");
            assert!(is_cloud(cloud, &lines("cloud", number)), "sweep {number}");
            let found = object(obstacles, &advertised[2]);
            let expected = &lines("obstacles", number)[0];
            assert!(are_obstacles(&found, expected), "{found} {expected}");
        }
        // When the last viewer has left, the server drops its subscriptions.
        drop(viewer);
        wait_until("no subscriber", || seldom.map(|topic| env.subscribers(topic)) == [0, 0]);
    }
}

const SIDE_BUTTON: &str = "document.querySelector('[data-do=side]')";
const SWEPT_TEXT: &str = "document.querySelector('#swept').innerText";

#[test]
fn side_view_shows_sweeps_and_subscribes_to_points() {
    let hall = TiltHub::new();
    let Some(mut page) = browse(&hall.env, Appearance::LAPTOP) else { return };
    let (_server, host) = web(&hall.env, &[]);
    page.open(&format!("http://{host}/"));
    page.await_true("window.scanhub?.beams > 100");
    // As long as no sweep arrives, the page has no view from the side.
    page.press("h");
    let is_plain = format!("{SIDE_BUTTON}.hidden && !scanhub.aside && {SWEPT_TEXT} === ''");
    page.await_true(&is_plain);
    page.await_true("scanhub.foreground > 0");

    let tilt = hall.tilt(&["--as=hall", NEAR_FLAG]);
    page.await_true(&format!("!{SIDE_BUTTON}.hidden && /^hall: /.test({SWEPT_TEXT})"));
    page.await_true("scanhub.obstacles > 0 && scanhub.beams > 100");
    page.await_true(&format!("{SIDE_BUTTON}.offsetHeight >= 40"));
    assert_eq!(hall.env.subscribers("hall/cloud"), 0, "points are not seen from above");
    // While the mount tilts, the hub takes the floor for foreground, because the background was learned at another
    // angle. The page must not show this foreground.
    page.await_true("scanhub.sweeps[0].sweep !== undefined && scanhub.foreground === 0");
    let script = "new Promise((done) => {
        const until = scanhub.scans.front + 40;
        let most = 0;
        const look = () => {
            most = Math.max(most, scanhub.foreground);
            if (scanhub.scans.front < until) requestAnimationFrame(look); else done(most);
        };
        look();
    })";
    assert_eq!(page.ask(script), 0);
    assert_eq!(page.ask("scanhub.axes"), 2);
    page.press("h");
    page.await_true(&format!("scanhub.aside && {SIDE_BUTTON}.ariaPressed === 'true'"));
    page.await_true("scanhub.swept > 1000 && scanhub.obstacles > 0 && scanhub.reason === null");
    assert_eq!(hall.env.subscribers("hall/cloud"), 1);
    page.await_true(&format!("/^hall: [1-9][0-9]* obstacles?, nearest 1\\.[3-5] m/.test({SWEPT_TEXT})"));
    page.await_true("document.querySelector('#map').ariaLabel.includes('from the side')");
    // In this view, the axes have names, and the floor is at the bottom of the free part of the picture.
    page.await_true("scanhub.axes === 2");
    let floor = "document.querySelector('nav').getBoundingClientRect().top - scanhub.screen(0, 0)[1]";
    page.await_true(&format!("{floor} > 20 && {floor} < 120"));
    // In this view, the direction ahead is to the right, and up is up.
    let place = "scanhub.screen(1, -2).map(Math.round).join() !== scanhub.screen(0, 0).map(Math.round).join() && \
                 scanhub.screen(1, -2)[0] > scanhub.screen(0, 0)[0] && scanhub.screen(1, -2)[1] < scanhub.screen(0, 0)[1]";
    page.await_true(place);
    page.mouse("mouseMoved", (500.0, 400.0), false);
    page.await_true("/above the floor/.test(document.querySelector('#readout').innerText)");

    // Keys show and hide layers, rotate the view and reset it.
    page.press("o");
    page.await_true("scanhub.obstacles === 0");
    page.press("o");
    let before = page.ask("scanhub.swept").as_u64().expect("a number");
    for key in ["s", "b", "f"] {
        page.press(key);
    }
    page.await_true("scanhub.swept === 0");
    for key in ["s", "b", "f"] {
        page.press(key);
    }
    page.await_true(&format!("scanhub.swept > {}", before / 2));
    page.press("]");
    page.await_true("scanhub.view.turn > 0.2");
    page.press("c");
    page.await_true("scanhub.view.turn === 0");
    // A held picture does not change. After that, the picture continues.
    freeze_page(&mut page, "scanhub.swept > 1000 && scanhub.sweeps[0].sweep != null");
    let [sweep, points] = ["scanhub.sweeps[0].sweep", "scanhub.swept"].map(|what| page.ask(what));
    page.press("h");
    page.await_true("!scanhub.aside && scanhub.beams > 100");
    page.press("h");
    page.await_true(&format!(
        "scanhub.aside && scanhub.swept > 0 && scanhub.swept === {points} && scanhub.sweeps[0].sweep === {sweep}"
    ));
    page.press(" ");
    page.await_true(&format!("scanhub.sweeps[0].sweep !== {sweep}"));
    // After a switch to another view and back, the page waits for the next sweep. It must not show this as a problem.
    let waits = "/^Waiting for the next sweep\\s*$/.test(scanhub.reason)";
    page.await_true(&format!(
        "scanhub.sweeps[0].sweep && ({SIDE_BUTTON}.click(), {SIDE_BUTTON}.click(), {waits})"
    ));
    page.await_true("scanhub.swept > 1000 && scanhub.reason === null");

    // After `tilt` has exited, the page removes the sweeps and shows the reason.
    assert_eq!(tilt.end(INT).exit_code, Some(0));
    page.await_true("scanhub.swept === 0 && /hall: no sweep any more/.test(scanhub.reason)");
    page.await_true("/scanhub tilt/.test(scanhub.reason)");
    page.press("h");
    page.await_true("!scanhub.aside && scanhub.beams > 100 && scanhub.reason === null");
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
    end_cleanly(hall);
}

/// The demo with a mount prints the address of its page, and this page shows sweeps.
#[test]
fn demo_page_shows_sweeps() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    let home = tempfile::tempdir().expect("a directory");
    command.args(["demo", "--world", "tilt"]).env_clear().env("XDG_STATE_HOME", home.path());
    let mut demo = Program::start(command);
    let host = loop {
        if let Some((_, host)) = demo.next_text().split_once("browser: http://") {
            break host.trim_end_matches('/').to_owned();
        }
    };
    let mut viewer = connect_viewer(&host, "/", None).expect("an accepted viewer");
    let [cloud] = channels(&mut viewer, ["/hall/cloud"]);
    subscribe(&mut viewer, &[(0, &cloud["id"])]);
    // A busy machine may send only a part of a sweep, so wait for a cloud that is large enough.
    wait_until("a cloud", || {
        let Message::Binary(frame) = viewer.read().expect("an open connection") else { return false };
        read(&POINT_CLOUD, &frame[13..]).expect("a PointCloud2").number("width") > Some(100.0)
    });
    assert_eq!(demo.end(INT).exit_code, Some(0));
}

/// Checks that the page shows the picture of `docs/tilt.md`, a hall with all obstacles. The command that creates the
/// pictures, in `web_page.rs`, also creates this picture.
#[test]
fn page_shows_documented_states_from_the_side() {
    let env = TestEnv::new();
    let directory = std::env::var_os("SCANHUB_PICTURES");
    let look = Appearance { width: 1200, height: 440, ..Appearance::LAPTOP };
    let Some(mut page) = browse(&env, look) else { return };
    let _simulator =
        env.simulator(&["front"], &["--world=tilt", "--angles=mount", "--baud=500000", "--seed=3"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let command = commands_on("docs/tilt.md", &["scanhub tilt front --angles"]).remove(0);
    let mut tilt = env.start(&[command, vec!["--json".to_owned()]].concat());
    tilt.await_line("a sweep", is_class("obstacles"));
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    page.await_true(&format!("{SIDE_BUTTON}?.hidden === false"));
    page.press("h");
    page.await_true("scanhub.aside && scanhub.swept > 1000 && scanhub.axes === 2");
    if let Some(directory) = &directory {
        // The hall has a pole, a box, and a walking person. Wait for a complete sweep with at least two near obstacles.
        let condition = "scanhub.swept > 10_000 && scanhub.axes === 2 && scanhub.sweeps[0].complete === 'true' \
                    && scanhub.sweeps[0].obstacles.filter((one) => one.near === 'true').length >= 2 \
                    && document.querySelector('#sensors article.streaming:not(.lossy)') !== null \
                    && document.querySelector('#news').innerText === ''";
        // Shortly after the page has drawn the sweep, it shows the text about it.
        let is_reported = format!("{SWEPT_TEXT} === `hall: ${{scanhub.sweeps[0].words}}`");
        page.await_true(&format!(
            "{condition} && {is_reported} && scanhub.obstacles === scanhub.sweeps[0].obstacles.length"
        ));
        save_screenshot(&mut page, look, &Path::new(directory).join("web-side.png"));
    }
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
    let outcome = tilt.end(INT);
    assert!(
        outcome.exit_code == Some(0) && number(&outcome.of_class("summary")[0], "points") > 1000,
        "{outcome}"
    );
}
