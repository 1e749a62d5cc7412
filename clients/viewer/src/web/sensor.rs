//! The channels of one sensor: its scans, what stands before its background, and that. Refuses to know when a sample comes.

use crate::server::{Board, ChannelId, messages};
use scanhub_schema::{Background, Header, Scan};

/// What a sensor is told in.
pub(super) struct Channels {
    pub(super) sensor: String,
    scan: ChannelId,
    foreground: ChannelId,
    background: ChannelId,
    pub(super) status: ChannelId,
    /// The telegram of the last scan, and of the last foreground.
    scan_of: Option<Header>,
    foreground_of: Option<u64>,
}

impl Channels {
    pub(super) fn new(board: &Board, sensor: &str) -> Channels {
        Channels {
            sensor: sensor.to_owned(),
            scan: board.channel(messages::scan_channel(sensor)),
            foreground: board.channel(messages::foreground_channel(sensor)),
            background: board.channel(messages::background_channel(sensor)),
            status: board.channel(messages::status_channel(sensor)),
            scan_of: None,
            foreground_of: None,
        }
    }

    /// Puts up a scan. `message` is memory for what becomes of it, here and below.
    pub(super) fn put_scan(&mut self, board: &Board, message: &mut Vec<u8>, header: &Header, scan: &Scan) {
        self.scan_of = Some(*header);
        if board.is_wanted(self.scan) {
            message.clear();
            scanhub_ros::laser_scan(message, scanhub_ros::frame(&self.sensor), header, scan);
            board.put(self.scan, header.wall_ns, message);
        }
    }

    /// A foreground of this telegram came.
    pub(super) fn take_foreground(&mut self, seq: u64) {
        self.foreground_of = Some(seq);
    }

    /// Puts up the foreground of `seen` as soon as the scan of the same telegram is here, which says where its beams point.
    pub(super) fn put_foreground(
        &mut self,
        board: &Board,
        message: &mut Vec<u8>,
        seen: &crate::scene::Sensor,
    ) {
        let Some(header) = self.scan_of.filter(|header| self.foreground_of == Some(header.seq)) else {
            return;
        };
        self.foreground_of = None;
        let (Some(scan), Some(foreground)) = (&seen.scan, &seen.foreground) else { return };
        if board.is_wanted(self.foreground) {
            message.clear();
            scanhub_ros::foreground_cloud(
                message,
                scanhub_ros::frame(&self.sensor),
                &header,
                scan,
                foreground,
            );
            board.put(self.foreground, header.wall_ns, message);
        }
    }

    /// Puts up what was learned until this moment.
    pub(super) fn put_background(
        &mut self,
        board: &Board,
        message: &mut Vec<u8>,
        wall_ns: u64,
        model: &Background,
    ) {
        message.clear();
        messages::background(message, &self.sensor, wall_ns, model);
        board.put(self.background, wall_ns, message);
    }

    /// What it saw was true a moment ago, and is not any more.
    pub(super) fn clear(&self, board: &Board) {
        board.clear(self.scan);
        board.clear(self.foreground);
    }
}
