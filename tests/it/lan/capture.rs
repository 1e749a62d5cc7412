//! Captures of UDP datagrams, and the fields that tshark shows for them with the project's dissector.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use crate::testkit::{output, skip, succeeds};

/// Capture file in memory: pcap 2.4, in which every packet starts with its IPv4 header (link type 101).
#[derive(Default)]
pub(crate) struct Capture {
    packets: Vec<u8>,
}

/// Returns whether tshark is installed. Skips the test if it is missing.
pub(crate) fn has_tshark() -> bool {
    let found = succeeds(Command::new("tshark").arg("--version"));
    if !found {
        skip("tshark", "it is not installed (Debian: apt-get install tshark)");
    }
    found
}

impl Capture {
    /// Adds a datagram from 127.0.0.1 to 239.255.76.80, port 22200.
    pub(crate) fn add(&mut self, datagram: &[u8]) {
        let udp_len = 8 + datagram.len() as u16;
        let ip_len = 20 + udp_len;
        let len = u32::from(ip_len).to_le_bytes();
        self.packets.extend([[0; 4], [0; 4], len, len].concat());
        // IPv4 header: version and header length, total length, TTL 1, protocol UDP, no checksum.
        self.packets.extend([0x45, 0]);
        self.packets.extend(ip_len.to_be_bytes());
        self.packets.extend([0, 0, 0, 0, 1, 17, 0, 0]);
        self.packets.extend([127, 0, 0, 1, 239, 255, 76, 80]);
        for field in [40_000, 22_200, udp_len, 0] {
            self.packets.extend(field.to_be_bytes());
        }
        self.packets.extend(datagram);
    }

    /// Returns the values that tshark shows for these fields in each packet, joined by commas. `name` is the name of
    /// the capture file.
    pub(crate) fn fields(&self, name: &str, fields: &[String]) -> Vec<BTreeMap<String, String>> {
        self.fields_with(name, fields, &[])
    }

    /// Does the same as [`fields`](Self::fields), with these settings of the dissector.
    pub(crate) fn fields_with(
        &self,
        name: &str,
        fields: &[String],
        settings: &[String],
    ) -> Vec<BTreeMap<String, String>> {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}.pcap"));
        let head: [u32; 6] = [0xA1B2_C3D4, 4 << 16 | 2, 0, 0, 65_535, 101];
        let head = head.into_iter().flat_map(u32::to_le_bytes);
        std::fs::write(&path, head.chain(self.packets.iter().copied()).collect::<Vec<u8>>()).expect("a file");
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/wireshark/scanhub.lua");
        let mut tshark = Command::new("tshark");
        tshark.arg("-X").arg(format!("lua_script:{}", script.display())).arg("-r").arg(&path);
        // Dissect each packet twice, as Wireshark does, because the second pass must show the same values as the first.
        // Use a home directory without other settings and without an installed copy of the dissector.
        tshark.args(["-2", "-T", "fields"]).env("HOME", env!("CARGO_TARGET_TMPDIR"));
        tshark.env("XDG_CONFIG_HOME", env!("CARGO_TARGET_TMPDIR"));
        settings.iter().for_each(|setting| {
            tshark.args(["-o", setting]);
        });
        let names: Vec<&str> = fields.iter().map(String::as_str).chain([LUA_ERROR]).collect();
        for name in &names {
            tshark.args(["-e", name]);
        }
        let output = output(tshark).expect("tshark starts");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !errors.contains("Lua"), "{errors}");
        let text = String::from_utf8(output.stdout).expect("text");
        let line = |line: &str| {
            let values = line.split('\t').map(str::to_owned);
            let shown: BTreeMap<String, String> =
                names.iter().map(|&name| name.to_owned()).zip(values).collect();
            assert_eq!(shown[LUA_ERROR], "", "{line}");
            shown
        };
        text.lines().map(line).collect()
    }
}

/// Field in which tshark reports the error of a Lua script.
const LUA_ERROR: &str = "_ws.lua.error";
