//! Tests of a recording in a browser: time line, pause, single steps and rate, with buttons and keys. `web --replay`
//! runs a hub for this page alone, which ends with the server.

use crate::browser::Appearance;
use crate::testkit::{INT, Program, TestEnv, is_class, shared_memory};
use crate::web_page::browse;

/// Starts a web server that shows `file`, and returns the server and its address.
fn start_web(env: &TestEnv, file: &str, flags: &[&str]) -> (Program, String) {
    let words = ["web", "--json", "--listen", "127.0.0.1:0", "--replay", file];
    let mut web = env.start(&[&words, flags].concat());
    let ready = web.await_line("the address of the page", is_class("ready"));
    let url = ready["url"].as_str().expect("an address").to_owned();
    (web, url)
}

/// Number of scans of a log that plays for two minutes, which is longer than the page takes to load.
const SCAN_COUNT: u64 = 600;

/// Writes a CARMEN log with five scans per second. In each scan, the wall is nearer than in the scan before.
fn log(env: &TestEnv, scans: u64) -> String {
    let line = |n: u64| {
        let stamp = 1000.0 + 0.2 * n as f64;
        let range = format!(" {:.2}", 8.0 - 0.01 * (n % 600) as f64).repeat(181);
        format!("FLASER 181{range} 0 0 0 0 0 0 {stamp:.6} host {stamp:.6}\n")
    };
    env.file("wall.log", (0..scans).map(line).collect::<String>())
}

#[test]
fn page_has_controls_of_the_player() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let (server, url) = start_web(&env, &log(&env, SCAN_COUNT), &[]);
    page.open(&url);
    page.await_true("window.scanhub?.beams === 181 && scanhub.player && !scanhub.player.paused");
    let own = format!("sh_web-{}_", server.pid());
    assert!(!shared_memory(&own).is_empty(), "a hub of its own");
    page.await_true("document.querySelector('#line').max > 119 && document.querySelector('#line').value > 0");

    // A key pauses the replay. The picture must stay, even after the time for which a scan is valid.
    page.press("p");
    page.await_true("scanhub.player.paused && /paused/.test(document.querySelector('#played').innerText)");
    page.ask("window.pausedAt = performance.now()");
    page.await_true("performance.now() - window.pausedAt > 1500");
    let before = page.ask("scanhub.player.telegrams").as_u64().expect("a number");
    assert_eq!(page.ask("scanhub.beams"), 181);
    assert_eq!(page.ask("scanhub.reason"), serde_json::Value::Null);
    assert_eq!(page.ask("scanhub.verdict"), "unknown", "a paused picture must not show a current verdict");

    // A key and a button step by one telegram each.
    page.press(".");
    page.await_true(&format!("scanhub.player.telegrams === {}", before + 1));
    page.ask("document.querySelector('[data-order=step]').click()");
    page.await_true(&format!("scanhub.player.telegrams === {} && scanhub.player.paused", before + 2));
    page.await_true("scanhub.beams === 181");

    // Keys double the rate, and then halve it twice.
    page.press(">");
    page.await_true("scanhub.player.rate === 2");
    page.press("<");
    page.press("<");
    page.await_true("scanhub.player.rate === 0.5");
    for _ in 0..8 {
        page.press(">");
    }
    page.press("p");
    page.await_true("scanhub.player.over && /at its end/.test(document.querySelector('#played').innerText)");
    page.await_true(&format!(
        "document.querySelector('[data-order=step]').disabled && scanhub.player.telegrams === {SCAN_COUNT}"
    ));
    assert_eq!(page.ask("scanhub.beams"), 181, "the last scan must stay visible");
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
    let outcome = server.end(INT);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(shared_memory(&own).is_empty(), "the domain was not removed");
}

#[test]
fn recording_loops_and_missing_file_is_refused() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::PHONE) else { return };
    let (server, url) = start_web(&env, &log(&env, 8), &["--loop"]);
    page.open(&url);
    page.await_true("window.scanhub?.player?.lap >= 1 && scanhub.beams === 181");
    page.await_true("document.documentElement.scrollWidth <= 390");
    assert_eq!(server.end(INT).exit_code, Some(0));
    let outcome = env.run(&["web", "--json", "--replay", &env.path_argument("none.log")]);
    assert_eq!(
        (outcome.exit_code, &outcome.of_class("error")[0]["kind"]),
        (Some(66), &"input".into()),
        "{outcome}"
    );
    let outcome = env.run(&["web", "--loop"]);
    assert_eq!(outcome.exit_code, Some(2), "{outcome}");
}
