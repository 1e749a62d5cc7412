//! Tests of the web page in a browser: the page shows the state of the hub and the reason when no samples arrive, and
//! it recovers on its own.

use std::path::Path;

use crate::browser::{Appearance, Browser};
use crate::recorded_world::recorded_world;
use crate::testkit::{INT, KILL, Program, TERM, TestEnv, skip, wait_until};
use scanhub_sim::world::World;

/// World with a hall and a reflector.
const WORLD: &str =
    "[noise]\ntail = 0\n\n[[thing]]\nline = [[3000, -3000], [3000, 3000], [-3000, 3000], [-3000, -3000]]\n
[[thing]]\nline = [[900, 2000], [1000, 2000]]\nsurface = \"reflector\"\n";

/// Text that adds a post next to the robot to [`WORLD`].
const POST_WORLD: &str = "\n[[thing]]\nradius_mm = 60\npose = [0, 450]\n";

/// Starts a scanner in the hall, with `more` added to the world.
fn sensor(env: &TestEnv, more: &str) -> Program {
    let world = format!("--world={}", env.file("world", format!("{WORLD}{more}")));
    env.simulator(&["front"], &["--seed=71", "--baud=500000", &world])
}

/// Starts a browser with this appearance. If no browser is installed, skips the test and returns `None`.
pub(crate) fn browse(env: &TestEnv, appearance: Appearance) -> Option<Browser> {
    let browser = Browser::start(env.path("browser"), appearance);
    if browser.is_none() {
        skip("chromium", "there is no browser (Debian: apt-get install chromium)");
    }
    browser
}

/// Holds the picture at a time when `condition` is true. On a busy machine, the picture may be empty for a short time,
/// so this may take several tries.
pub(crate) fn freeze_page(page: &mut Browser, condition: &str) {
    wait_until("a picture is held", || {
        page.press(" ");
        page.await_true("document.querySelector('#verdict').innerText.includes('held')");
        let is_seen = page.ask(condition) == true;
        if !is_seen {
            page.press(" ");
        }
        is_seen
    });
}

/// Starts the server, and returns the server and its address.
fn web(env: &TestEnv, listen: &str) -> (Program, String) {
    let mut web = env.start(&["web", "--json", "--listen", listen]);
    let ready = web.await_line("the address of the page", |line| line["class"] == "ready");
    let url = ready["url"].as_str().expect("an address").to_owned();
    (web, url)
}

/// Script that returns the background color of the verdict.
const COLOR_SCRIPT: &str = "getComputedStyle(document.querySelector('#verdict strong')).backgroundColor";

#[test]
fn page_shows_samples_or_the_reason_for_their_absence() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let (server, url) = web(&env, "127.0.0.1:0");
    page.open(&url);
    page.await_true("window.scanhub?.connected && /no hub/.test(window.scanhub.reason)");
    assert_eq!(page.ask("scanhub.verdict"), "unknown");
    page.await_true("/scanhub run/.test(scanhub.reason)");
    let red = page.ask(COLOR_SCRIPT);

    // The scanner of the link does not reply yet, so the page shows the reason of the link.
    let hub = env.hub(&[env.link("front")]);
    page.await_true("/^front: ./.test(scanhub.reason)");
    let empty_hall = sensor(&env, "");
    page.await_true("scanhub.reason === null && scanhub.verdict === 'clear' && scanhub.beams > 100");
    page.await_true(&format!("scanhub.verdict === 'clear' && {COLOR_SCRIPT} !== {red}"));
    page.await_true("scanhub.zones === 2 && scanhub.marks > 0 && scanhub.sensors[0].hz > 0");
    page.await_true("document.querySelector('#sensors article').innerText.includes('streaming')");

    // The post was not there when the hub learned the background, and it is inside the inner zone.
    let learned = env.path("state/scanhub").join(env.domain().name()).join("front.background.json");
    wait_until("the background is learned", || learned.exists());
    assert_eq!(empty_hall.end(TERM).exit_code, Some(0));
    let _with_post = sensor(&env, POST_WORLD);
    page.await_true("scanhub.verdict === 'stop' && scanhub.foreground > 2");
    page.await_true("document.querySelector('#verdict').innerText.startsWith('STOP')");
    page.await_true(&format!("scanhub.verdict === 'stop' && {COLOR_SCRIPT} === {red}"));
    // While the picture is held, the verdict must still be the current one.
    freeze_page(&mut page, "scanhub.beams > 100");
    hub.end(KILL);
    page.await_true("scanhub.verdict === 'unknown'");
    page.await_true("/no hub/.test(scanhub.reason)");
    page.press("s");
    page.await_true("scanhub.beams === 0");
    page.press("s");
    page.await_true("scanhub.beams > 100");
    page.press(" ");
    page.await_true("scanhub.beams === 0");
    let _hub = env.hub(&[env.link("front")]);
    page.await_true("scanhub.verdict === 'stop' && scanhub.beams > 100");

    // The connection is lost, and another server starts at the same address.
    let address = url.trim_start_matches("http://").trim_end_matches('/').to_owned();
    server.end(INT);
    page.await_true("scanhub.verdict === 'unknown' && /No connection/.test(scanhub.reason)");
    let (_server, again) = web(&env, &address);
    assert_eq!(again, url);
    page.await_true("scanhub.verdict === 'stop' && scanhub.beams > 100 && scanhub.reason === null");
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
}

#[test]
fn page_drops_sensors_of_previous_server() {
    let (first, second) = (TestEnv::new(), TestEnv::new());
    let Some(mut page) = browse(&first, Appearance::LAPTOP) else { return };
    let simulators = [
        first.simulator(&["front", "rear"], &["--seed=71", "--baud=500000"]),
        second.simulator(&["rear"], &["--seed=72", "--baud=500000"]),
    ];
    let hubs = [first.hub(&[first.link("front"), first.link("rear")]), second.hub(&[second.link("rear")])];
    let (server, url) = web(&first, "127.0.0.1:0");
    page.open(&url);
    let titles = "[...document.querySelectorAll('#sensors h2 button')].map((one) => one.textContent).join()";
    page.await_true(&format!("window.scanhub?.beams > 600 && {titles} === '1  front,2  rear'"));
    page.press("1");
    page.await_true("scanhub.beams > 0 && scanhub.beams <= 361");

    // A held picture does not change, but the list no longer shows the sensors of the first server as streaming.
    freeze_page(&mut page, "scanhub.beams > 100");
    let address = url.trim_start_matches("http://").trim_end_matches('/').to_owned();
    assert_eq!(server.end(INT).exit_code, Some(0));
    page.await_true("/No connection/.test(scanhub.reason)");
    let (server, _) = web(&second, &address);
    let states = "[...document.querySelectorAll('#sensors article')].map((one) => one.classList[0]).join()";
    page.await_true(&format!("{titles} === '1  front,2  rear' && {states} === 'no-status,streaming'"));
    assert!(page.ask("scanhub.beams").as_u64() > Some(100));
    page.press(" ");
    page.await_true(&format!("{titles} === '1  rear' && {states} === 'streaming' && scanhub.beams > 100"));

    // If the picture is not held, the page removes the sensors of the previous server as soon as it has connected.
    assert_eq!(server.end(INT).exit_code, Some(0));
    page.await_true("/No connection/.test(scanhub.reason)");
    let (server, _) = web(&first, &address);
    page.await_true(&format!("{titles} === '1  front,2  rear' && scanhub.beams > 600"));
    assert_eq!(server.end(INT).exit_code, Some(0));
    page.await_true("/No connection/.test(scanhub.reason)");
    let (_server, _) = web(&second, &address);
    page.await_true(&format!("{titles} === '1  rear' && {states} === 'streaming' && scanhub.beams > 100"));
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
    drop((simulators, hubs));
}

#[test]
fn keys_and_the_mouse_change_the_picture() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::PHONE) else { return };
    let _sensor = sensor(&env, POST_WORLD);
    let _hub = env.hub(&[env.link("front")]);
    let (_server, url) = web(&env, "127.0.0.1:0");
    page.open(&url);
    page.await_true("window.scanhub?.beams > 100 && scanhub.zones === 2");
    for (key, layer) in [("z", "zones"), ("m", "marks"), ("s", "beams")] {
        page.press(key);
        page.await_true(&format!("scanhub.{layer} === 0"));
        page.press(key);
        page.await_true(&format!("scanhub.{layer} > 0"));
    }
    // The hub computes lines only while they have a subscriber.
    assert_eq!(page.ask("scanhub.lines"), 0);
    assert_eq!(env.subscribers("front/lines"), 0);
    page.press("e");
    page.await_true("scanhub.lines >= 3");
    assert_eq!(env.subscribers("front/lines"), 1);
    page.press("e");
    page.await_true("scanhub.lines === 0");
    wait_until("no subscriber", || env.subscribers("front/lines") == 0);
    let fits = "document.querySelector('[data-do=fit]').getAttribute('aria-pressed')";
    assert_eq!(page.ask(fits), "true");
    page.mouse("mousePressed", (180.0, 300.0), true);
    page.mouse("mouseMoved", (220.0, 330.0), true);
    page.mouse("mouseReleased", (220.0, 330.0), false);
    page.await_true(&format!("{fits} === 'false'"));
    page.press("c");
    page.await_true(&format!("{fits} === 'true'"));
    // A busy browser drops movements of the mouse, so move the mouse until the page reacts.
    let mut steps = (0..).map(|step| 195.0 + f64::from(step % 2));
    wait_until("the place under the mouse is read out", || {
        page.mouse("mouseMoved", (steps.next().expect("an endless sequence"), 300.0), false);
        page.ask("/from the robot/.test(document.querySelector('#readout').innerText)") == true
    });
    let paper = "getComputedStyle(document.body).backgroundColor";
    let before = page.ask(paper);
    page.press("n");
    page.await_true(&format!("{paper} !== {before}"));
    page.press("n");
    page.await_true(&format!("{paper} === {before}"));
    page.press("?");
    page.await_true("document.querySelector('#help').open");
    page.press("Escape");
    page.await_true("!document.querySelector('#help').open");
    // No part of the page is wider than the screen, and every button is large enough for a finger.
    page.await_true("document.documentElement.scrollWidth <= 390");
    // Leave out hidden buttons, which have no height.
    let small = "[...document.querySelectorAll('nav button:not([hidden])')].filter((one) => one.offsetHeight < 40).length";
    assert_eq!(page.ask(small), 0);
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
}

/// Writes a screenshot of the page to a PNG file. Moves the mouse first, so that the page does not show the position
/// under the mouse.
pub(crate) fn save_screenshot(page: &mut Browser, appearance: Appearance, path: &Path) {
    // Move the mouse to the edge of the box of buttons, between the border and the first button.
    page.mouse("mouseMoved", (14.0, f64::from(appearance.height) - 30.0), false);
    page.await_true("document.querySelector('#readout').innerText === ''");
    page.save_screenshot(path);
}

/// Returns a script that counts the pixels with the color `name` in the first sensor's curve of the share of damaged
/// bytes.
fn curve(name: &str) -> String {
    format!(
        "(() => {{
            const probe = document.body.appendChild(document.createElement('i'));
            probe.style.color = 'var(--{name})';
            const wanted = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
            probe.remove();
            const canvas = document.querySelectorAll('#sensors canvas')[2];
            const {{ data }} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
            let count = 0;
            for (let i = 0; i < data.length; i += 4) count += data[i + 3] > 100 && wanted.every((one, n) => Math.abs(one - data[i + n]) < 30);
            return count;
        }})()"
    )
}

/// Checks the page in the states that the pictures of the documents show. `SCANHUB_PICTURES=docs cargo test --test it
/// page_shows_documented_states` creates these pictures again, and takes a minute for each. The pictures show a
/// recording, because the simulator loses bytes on a busy machine.
#[test]
fn page_shows_documented_states() {
    let env = TestEnv::new();
    let directory = std::env::var_os("SCANHUB_PICTURES");
    let world: World = "demo".parse().expect("a world");
    let file = recorded_world(&env, &world, &["front", "rear"], if directory.is_some() { 900 } else { 180 });
    let poses = ["front.pose.x=0.3", "rear.pose.x=-0.3", "rear.pose.yaw=3.14159"];
    let poses = poses.map(|pose| format!("--set=link.{pose}"));
    let replay = [["replay", &file, "--json", "--hold"].map(str::to_owned).to_vec(), poses.to_vec()].concat();
    let _hub = env.start(&replay).ready();
    let (_server, url) = web(&env, "127.0.0.1:0");
    let dark = Appearance { scheme: "dark", ..Appearance::LAPTOP };
    for (name, look) in
        [("web-light", Appearance::LAPTOP), ("web-dark", dark), ("web-phone", Appearance::PHONE)]
    {
        let Some(mut page) = browse(&env, look) else { return };
        page.open(&url);
        let condition =
            "window.scanhub?.verdict === 'slow' && scanhub.foreground > 20 && scanhub.beams > 600";
        page.await_true(condition);
        page.await_true("scanhub.zones === 2 && scanhub.marks >= 2 && scanhub.sensors.length === 2");
        page.await_true("document.querySelectorAll('#sensors article.streaming').length === 2");
        // The recording has no damaged bytes, so the curve of their share is gray.
        page.await_true(&format!("{} > 0 && {} === 0", curve("soft"), curve("slow")));
        page.await_true(
            "/^0–50 Hz, 2 min; p99, 0–[125]0* ms, 2 min; 0–1 %, 2 min$/.test(\
             [...document.querySelectorAll('#sensors article:first-child small')].map((one) => one.innerText).join('; '))",
        );
        if let Some(directory) = &directory {
            for _ in 0..6 {
                page.ask("new Promise((done) => setTimeout(done, 10_000))");
            }
            let quiet =
                "!document.querySelector('#sensors .lossy') && !document.querySelector('#news').innerText";
            page.ask(&format!(
                "new Promise((done) => {{
                    const look = () => ({condition}) && ({quiet}) ? done() : requestAnimationFrame(look);
                    look();
                }})"
            ));
            save_screenshot(&mut page, look, &Path::new(directory).join(format!("{name}.png")));
        }
        assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
    }
}
