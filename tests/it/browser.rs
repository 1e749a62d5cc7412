//! Headless Chromium that a test controls through its debugging protocol: it opens pages, evaluates scripts and takes
//! screenshots.

use std::fs;
use std::io::{BufRead, BufReader, ErrorKind};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

use crate::testkit::{Child, WAIT_TIMEOUT, spawn};

/// Names of the browser's program in Debian. The first program can open windows, the second one cannot.
const BROWSER_NAMES: [&str; 2] = ["chromium", "chromium-headless-shell"];

/// Window and device in which the browser shows a page.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Appearance {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Color scheme: `light` or `dark`.
    pub(crate) scheme: &'static str,
    /// Whether the device is a phone, with two pixels per point and touch input.
    pub(crate) is_phone: bool,
}

impl Appearance {
    pub(crate) const LAPTOP: Appearance =
        Appearance { width: 1280, height: 800, scheme: "light", is_phone: false };
    pub(crate) const PHONE: Appearance =
        Appearance { width: 390, height: 844, scheme: "dark", is_phone: true };
}

/// Browser with one page.
pub(crate) struct Browser {
    process: Child,
    socket: WebSocket<TcpStream>,
    session: String,
    calls: u64,
    profile: PathBuf,
    /// Errors and warnings that the page wrote to the console.
    pub(crate) console_errors: Vec<String>,
}

impl Browser {
    /// Starts a browser with its profile in the directory `profile`. Returns `None` if there is no Chromium.
    pub(crate) fn start(profile: PathBuf, appearance: Appearance) -> Option<Browser> {
        let spawned = BROWSER_NAMES.iter().find_map(|name| {
            let mut command = Command::new(name);
            command.args(["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]);
            command.args(["--remote-debugging-port=0", "--no-first-run", "--disable-dev-shm-usage"]);
            command.arg(format!("--user-data-dir={}", profile.display())).arg("about:blank");
            spawn(command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped())).ok()
        });
        let mut process = spawned?;
        let mut lines = BufReader::new(process.stderr.take()?).lines().map_while(Result::ok);
        let address = lines.find_map(|line| Some(line.split_once("listening on ws://")?.1.to_owned()));
        let address = address.unwrap_or_else(|| panic!("the browser does not print its debugging address"));
        // Read the rest of the browser's stderr, so that a full pipe does not block the browser.
        thread::spawn(move || lines.for_each(drop));
        let (host, _) = address.split_once('/').expect("a path");
        let stream = TcpStream::connect(host).expect("the debugging port accepts connections");
        stream.set_read_timeout(Some(WAIT_TIMEOUT)).expect("a timeout");
        let (socket, _) =
            tungstenite::client(format!("ws://{address}"), stream).expect("the WebSocket handshake succeeds");
        let mut browser = Browser {
            process,
            socket,
            session: String::new(),
            calls: 0,
            profile,
            console_errors: Vec::new(),
        };
        let target = browser.call("Target.createTarget", json!({ "url": "about:blank" }));
        let attached = json!({ "targetId": target["targetId"], "flatten": true });
        let session = browser.call("Target.attachToTarget", attached);
        browser.session = session["sessionId"].as_str().expect("a session").to_owned();
        for domain in ["Page", "Runtime", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        browser.set_appearance(appearance);
        Some(browser)
    }

    /// Sets the size of the window, the color scheme and the kind of device.
    pub(crate) fn set_appearance(&mut self, appearance: Appearance) {
        let Appearance { width, height, scheme, is_phone } = appearance;
        let ratio = if is_phone { 2 } else { 1 };
        let screen =
            json!({ "width": width, "height": height, "deviceScaleFactor": ratio, "mobile": is_phone });
        self.call("Emulation.setDeviceMetricsOverride", screen);
        // With reduced motion, the view reaches its final position in the next frame, without an animation, so the test
        // does not have to wait for an animation.
        let features = json!([
            { "name": "prefers-color-scheme", "value": scheme },
            { "name": "prefers-reduced-motion", "value": "reduce" },
        ]);
        self.call("Emulation.setEmulatedMedia", json!({ "features": features }));
    }

    pub(crate) fn open(&mut self, url: &str) {
        self.call("Page.navigate", json!({ "url": url }));
    }

    /// Evaluates `script` on the page, and returns its value.
    pub(crate) fn ask(&mut self, script: &str) -> Value {
        let parameters = json!({ "expression": script, "returnByValue": true, "awaitPromise": true });
        let response = self.call("Runtime.evaluate", parameters);
        assert!(response.get("exceptionDetails").is_none(), "{script}: {response}");
        response["result"]["value"].clone()
    }

    /// Waits until `script` evaluates to true on the page.
    pub(crate) fn await_true(&mut self, script: &str) {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        while self.ask(script) != Value::Bool(true) {
            let page_state = |browser: &mut Browser| browser.ask("JSON.stringify(window.scanhub)");
            assert!(
                Instant::now() < give_up_at,
                "timeout: {script} is not true; state of the page: {}",
                page_state(self)
            );
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Presses and releases `key`, which is a value of `KeyboardEvent.key`.
    pub(crate) fn press(&mut self, key: &str) {
        // The browser's own reaction to a key depends on its key code and its text.
        let (number, text) = match key {
            "Tab" => (9, ""),
            "Escape" => (27, ""),
            "Enter" => (13, "\r"),
            " " => (32, " "),
            _ => (0, ""),
        };
        for kind in ["keyDown", "keyUp"] {
            let mut pressed = json!({ "type": kind, "key": key, "windowsVirtualKeyCode": number });
            if kind == "keyDown" && !text.is_empty() {
                pressed["text"] = text.into();
            }
            self.call("Input.dispatchKeyEvent", pressed);
        }
    }

    /// Sends a mouse event of this `kind` at the position (`x`, `y`), with the left button pressed if `is_held` is
    /// true.
    pub(crate) fn mouse(&mut self, kind: &str, (x, y): (f64, f64), is_held: bool) {
        let button = if is_held { "left" } else { "none" };
        let buttons = u8::from(is_held);
        let moved =
            json!({ "type": kind, "x": x, "y": y, "button": button, "buttons": buttons, "clickCount": 1 });
        self.call("Input.dispatchMouseEvent", moved);
    }

    /// Writes a screenshot of the page to a PNG file.
    pub(crate) fn save_screenshot(&mut self, path: &Path) {
        let response = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        let text = response["data"].as_str().expect("the response has a screenshot");
        fs::write(path, from_base64(text)).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    }

    /// Calls a method of the debugging protocol, and returns the result.
    pub(crate) fn call(&mut self, method: &str, params: Value) -> Value {
        self.calls += 1;
        let mut call = json!({ "id": self.calls, "method": method, "params": params });
        if !self.session.is_empty() {
            call["sessionId"] = self.session.clone().into();
        }
        self.socket.send(Message::text(call.to_string())).expect("the browser accepts the call");
        loop {
            let response = match self.socket.read() {
                // The test process was stopped and continued in the meantime, for example because its virtual machine
                // was suspended.
                Err(tungstenite::Error::Io(error)) if error.kind() == ErrorKind::Interrupted => continue,
                result => result.unwrap_or_else(|error| panic!("{method}: {error}")),
            };
            let Message::Text(text) = response else { continue };
            let response: Value = serde_json::from_str(&text).expect("JSON");
            if response["id"] == self.calls {
                assert!(response.get("error").is_none(), "{method}: {response}");
                return response["result"].clone();
            }
            let is_complaint = response["method"] == "Runtime.exceptionThrown"
                || response["method"] == "Log.entryAdded"
                    && response["params"]["entry"]["source"] == "security";
            if is_complaint {
                self.console_errors.push(response["params"].to_string());
            }
        }
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        self.process.end();
        let _ = fs::remove_dir_all(&self.profile);
    }
}

/// Decodes base64 (RFC 4648) without line feeds.
fn from_base64(text: &str) -> Vec<u8> {
    let value = |sign: u8| match sign {
        b'A'..=b'Z' => sign - b'A',
        b'a'..=b'z' => sign - b'a' + 26,
        b'0'..=b'9' => sign - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let mut bytes = Vec::with_capacity(text.len() * 3 / 4);
    for four in text.trim_end_matches('=').as_bytes().chunks(4) {
        let bits = four.iter().fold(0_u32, |bits, sign| bits << 6 | u32::from(value(*sign)));
        let bits = bits << (6 * (4 - four.len()));
        bytes.extend(&bits.to_be_bytes()[1..four.len()]);
    }
    bytes
}
