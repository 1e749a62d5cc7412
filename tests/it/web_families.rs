//! Tests of sensors of every family and with every way of mounting, in one picture. Some have equal steps between beams
//! and some have exact angles. Some are upside down, some have overlapping fields of view, and some are remote. The
//! tests compare the points on the page with points that they compute from scans and poses.

use serde_json::Value;

use crate::browser::{Appearance, Browser};
use crate::testkit::{INT, TestEnv, TestGateway, in_a_network, number, wait_until};
use crate::web::web;
use crate::web_page::browse;
use scanhub_schema::{ArrayFlags, Header, Pose, Scan, ScanHead, State, Status, Topic, Verdict, Zones};
use scanhub_viewer::scene::{PointerPosition, Scene};

/// World with a hall that has no symmetry.
const HALL_WORLD: &str = "[noise]\ntail = 0\n\n[[thing]]\nline = [[3000, -2500], [3500, 4000], [-2000, 3000], [-4000, -3000], [3000, -2500]]\n
[[thing]]\nradius_mm = 150\npose = [900, 1300]\n";

/// Returns the points of `sensor` on the page, in the robot's frame in meters. Both coordinates are NaN for a beam
/// without a point.
fn drawn_points(page: &mut Browser, sensor: &str) -> Vec<(f64, f64)> {
    let points = page.ask(&format!("scanhub.points('{sensor}')"));
    let numbers: Vec<f64> =
        points.as_array().expect("points").iter().map(|value| value.as_f64().unwrap_or(f64::NAN)).collect();
    numbers.chunks(2).map(|pair| (pair[0], pair[1])).collect()
}

/// Returns the two numbers of a list.
fn pair(value: &Value) -> (f64, f64) {
    (value[0].as_f64().expect("a number"), value[1].as_f64().expect("a number"))
}

/// Returns the points at which the beams of a line of class `scan` end, in the robot's frame in meters. `pose` is the
/// pose of the sensor.
fn measured_points(scan: &Value, pose: &Pose) -> Vec<(f64, f64)> {
    let unit_mm = number(scan, "unit_um") as f64 / 1000.0;
    let (first, step) =
        (scan["first_angle_deg"].as_f64().expect("a number"), scan["step_deg"].as_f64().expect("a number"));
    let ranges = scan["ranges"].as_array().expect("ranges").iter().enumerate();
    let point = |(i, range): (usize, &Value)| {
        let angle = scan["angles_deg"][i].as_f64().unwrap_or(first + i as f64 * step);
        let (x, y) = pose.point_mm(angle.to_radians(), range.as_f64()? * unit_mm);
        Some((x / 1000.0, y / 1000.0))
    };
    ranges.filter_map(point).collect()
}

#[test]
fn scans_of_every_family_are_drawn_in_place() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let world = format!("--world={}", env.file("world", HALL_WORLD));
    let _lms = env.simulator(&["front", "flipped"], &["--seed=7", "--baud=500000", &world]);
    let _rplidar = env.simulator(&["top"], &["--family=rplidar", "--model=s2", "--seed=8", &world]);
    let links = [env.link("front"), env.link("flipped"), env.link("top")];
    let set = [
        "front.pose.x=0.3",
        "flipped.pose.x=-0.2",
        "flipped.pose.yaw=0.6",
        "flipped.pose.upside_down=true",
        "top.family=rplidar",
        "top.model=s2",
        "top.beams=3240",
    ];
    let _hub = env.hub(&[&links[..], &set.map(|setting| format!("--set=link.{setting}"))].concat());
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    page.await_true(
        "window.scanhub?.sensors.length === 3 && scanhub.sensors.every(({ state }) => state === 'streaming')",
    );
    page.await_true("scanhub.points('front').length === 722 && scanhub.points('top').length === 6480");
    page.await_true("scanhub.points('flipped').length === 722");
    let poses = [
        ("front", Pose { x_m: 0.3, ..Pose::default() }),
        ("flipped", Pose { x_m: -0.2, yaw_rad: 0.6, upside_down: 1, ..Pose::default() }),
        ("top", Pose::default()),
    ];
    for (sensor, pose) in poses {
        // On a busy machine, a scan may have gaps, and the page removes a scan that is too old. Therefore try again.
        wait_until(&format!("the sensor {sensor} at its place"), || {
            let outcome = env.run(&["echo", "--json", "-n", "1", &format!("{sensor}/scan")]);
            let scan = outcome.of_class("scan").pop().unwrap_or_else(|| panic!("no scan: {outcome}"));
            let (measured_now, drawn_points) =
                (measured_points(&scan, &pose), drawn_points(&mut page, sensor));
            let is_there =
                |(x, y): &&(f64, f64)| drawn_points.iter().any(|(a, b)| (a - x).hypot(b - y) < 0.1);
            measured_now.len() > 300
                && measured_now.iter().filter(is_there).count() * 100 >= measured_now.len() * 97
        });
    }
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
}

#[test]
fn remote_sensors_are_listed_but_not_on_this_robot() {
    in_a_network("web_families::remote_sensors_are_listed_but_not_on_this_robot", || {
        let env = TestEnv::new();
        let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
        let mut sender = TestGateway::new(0x5f3a_12bc_00d1_e2f3, 7, 3, "front");
        let words = ["listen", "--json", "--publish", "--name=robot1=5f3a12bc00d1e2f3"];
        let mut listener = env.start(&words).ready();
        let topics = [Topic::Zones, Topic::Scan, Topic::Status];
        sender.wait_until_published(&mut listener, &topics);
        // This hall has no object near the sensor.
        let world = format!("--world={}", env.file("world", HALL_WORLD));
        let _lms = env.simulator(&["rear"], &["--seed=7", "--baud=500000", &world]);
        let _hub = env.hub(&[env.link("rear")]);
        let (_server, host) = web(&env, &[]);
        page.open(&format!("http://{host}/"));
        page.await_true("window.scanhub?.points('rear').length === 722");
        let head = ScanHead {
            intensity_bits: 8,
            contents: ArrayFlags::UPPER,
            ..ScanHead::lms(181, -90_000, 1000, 1, 13)
        };
        let mut scan = Scan::of(head, &[2000; 181]);
        scan.arrays().upper.fill(77);
        // Announce the remote sensor and send its samples repeatedly, as a gateway does, so that the sensor does not
        // become absent, however long the other steps take.
        let mut send_until = |page: &mut Browser, measured_now: &str| {
            wait_until(measured_now, || {
                sender.announce(&topics);
                sender.send(Topic::Status, &Status { state: State::Streaming as u8, ..Status::default() });
                sender.send(Topic::Scan, &*scan);
                sender.send(Topic::Zones, &Zones { verdict: Verdict::Stop as u8, ..Zones::unknown() });
                page.ask(measured_now) == Value::Bool(true)
            });
        };
        let card = "[...document.querySelectorAll('#sensors h2')].some((one) => /robot1\\.front/.test(one.innerText))";
        send_until(&mut page, card);
        send_until(&mut page, "scanhub.points('robot1.front').length === 362");
        // The remote sensor belongs to another robot, so it must not affect the verdict of this robot.
        send_until(&mut page, "scanhub.beams > 300 && scanhub.beams <= 361 && scanhub.verdict === 'clear'");
        let number = "[...document.querySelectorAll('#sensors button')].find((one) => /robot1/.test(one.innerText)).click()";
        page.ask(number);
        send_until(&mut page, "scanhub.beams === 181");
        // The page must show the same text for a position as `watch` does, which uses the same code for the scene.
        let mut scene = Scene::default();
        scene.sensor("robot1.front").take_status(&Status::default());
        scene.sensor("robot1.front").take_scan(&Header::default(), &scan, 0);
        // Check three points, and a position without a point. The key stops the automatic fit of the view.
        page.press("-");
        let beam = |degrees: f64| (2.0 * degrees.to_radians().cos(), 2.0 * degrees.to_radians().sin());
        for (x, y) in [beam(0.0), beam(-53.0), beam(90.0), (0.7, 0.4)] {
            let pixels = pair(&page.ask(&format!("scanhub.screen({x}, {y}).map(Math.round)")));
            page.mouse("mouseMoved", pixels, false);
            let at_m = pair(&page.ask(&format!("scanhub.place({}, {})", pixels.0, pixels.1)));
            let within_m = 14.0 / page.ask("scanhub.view.scale").as_f64().expect("pixels per meter");
            let words = PointerPosition::of(scene.sensors.iter(), at_m, within_m).text_lines();
            let (lines, last) = words.split_at(words.len().min(3));
            let last: String = last.iter().map(|word| format!(", {word}")).collect();
            let text = lines.join("\\n") + &last;
            send_until(&mut page, &format!("document.querySelector('#readout').textContent === '{text}'"));
        }
        let outcome = listener.end(INT);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    });
}
