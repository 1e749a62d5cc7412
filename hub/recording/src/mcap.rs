//! Recordings of the hub: what an MCAP file holds of each sensor, and its telegrams. Refuses to know how samples got
//! into the file, and what other programs have put there.

mod channels;
mod records;

use std::collections::BTreeMap;
use std::io::Read;
use std::sync::Arc;

use lms::variant::Mode;
use mcap::records::{MessageHeader, Record as Parsed};
use mcap::{McapError, parse_record};
use schema::datagram::Packed;
use schema::{Header, Status, Topic, file};

use crate::{Contents, Form, Frame};
use channels::Channels;
use records::{Record, Records};

/// What is known of a file that was read through once.
#[derive(Debug)]
pub(crate) struct Survey {
    whole: Contents,
    sensors: Vec<(String, Contents)>,
    channels: Channels,
    /// Last life of the hub and number of a telegram, by sensor.
    last: BTreeMap<String, (u64, u64)>,
}

impl Default for Survey {
    fn default() -> Self {
        Survey {
            whole: Contents::new(Form::Mcap),
            sensors: Vec::new(),
            channels: Channels::default(),
            last: BTreeMap::new(),
        }
    }
}

impl Survey {
    /// Reads `input` through.
    pub(crate) fn of(input: impl Read) -> std::io::Result<Survey> {
        let mut survey = Survey::default();
        let mut records = Records::new(input);
        loop {
            match records.next() {
                Ok(Some(record)) => survey.note(&record),
                Ok(None) => return Ok(survey),
                Err(McapError::UnsupportedCompression(name)) => {
                    let message = format!("its chunks are packed by {name}");
                    return Err(std::io::Error::new(std::io::ErrorKind::Unsupported, message));
                }
                Err(_) => {
                    survey.whole.damage.is_cut = true;
                    survey.sensors.iter_mut().for_each(|(_, contents)| contents.damage.is_cut = true);
                    return Ok(survey);
                }
            }
        }
    }

    /// What is in the file.
    pub(crate) fn contents(&self) -> Contents {
        Contents {
            sensors: self.sensors.iter().map(|(name, _)| name.clone()).collect(),
            ..self.whole.clone()
        }
    }

    /// What is in it of `sensor`.
    pub(crate) fn contents_of(&self, sensor: &str) -> Contents {
        let found = self.sensors.iter().find(|(name, _)| name == sensor);
        let (name, contents) = found.cloned().unwrap_or((sensor.to_owned(), Contents::new(Form::Mcap)));
        Contents { sensors: vec![name], ..contents }
    }

    fn note(&mut self, record: &Record) {
        match parse_record(record.opcode, &record.body) {
            Ok(Parsed::Channel(channel)) => {
                self.channels.note(&channel);
                if let Some(place) = self.channels.place(channel.id).cloned() {
                    self.of_sensor(&place.sensor);
                }
            }
            Ok(Parsed::Message { header, data }) => self.note_message(&header, &data),
            _ => {}
        }
    }

    fn note_message(&mut self, message: &MessageHeader, data: &[u8]) {
        let Some(place) = self.channels.place(message.channel_id).cloned() else { return };
        let Some((header, payload)) = file::parts(data) else { return };
        match place.topic {
            Topic::Telegram => self.note_telegram(&place.sensor, &header, payload),
            Topic::Status => {
                let mut status = Status::default();
                if status.unpack(payload) && status.mode != Status::MODE_UNKNOWN {
                    let mode = Mode(status.mode);
                    self.whole.mode = self.whole.mode.or(Some(mode));
                    let contents = self.of_sensor(&place.sensor);
                    contents.mode = contents.mode.or(Some(mode));
                }
            }
            _ => {}
        }
    }

    fn note_telegram(&mut self, sensor: &str, header: &Header, telegram: &[u8]) {
        let missing = match self.last.insert(sensor.to_owned(), (header.boot, header.topic_seq)) {
            Some((boot, last)) if boot == header.boot => header.topic_seq.saturating_sub(last + 1),
            _ => 0,
        };
        self.whole.damage.telegrams += missing;
        self.whole.note(telegram, Some(header.wall_ns));
        let contents = self.of_sensor(sensor);
        contents.damage.telegrams += missing;
        contents.note(telegram, Some(header.wall_ns));
    }

    fn of_sensor(&mut self, sensor: &str) -> &mut Contents {
        let found = self.sensors.iter().position(|(name, _)| name == sensor);
        let number = found.unwrap_or_else(|| {
            self.sensors.push((sensor.to_owned(), Contents::new(Form::Mcap)));
            self.sensors.len() - 1
        });
        &mut self.sensors[number].1
    }
}

/// The telegrams of one sensor, in the order of the file.
pub(crate) struct Frames<R> {
    records: Records<R>,
    survey: Arc<Survey>,
    sensor: String,
}

impl<R: Read> Frames<R> {
    pub(crate) fn new(input: R, survey: Arc<Survey>, sensor: String) -> Self {
        Frames { records: Records::new(input), survey, sensor }
    }
}

impl<R: Read> Iterator for Frames<R> {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        loop {
            let record = self.records.next().ok()??;
            let Ok(Parsed::Message { header: message, data }) = parse_record(record.opcode, &record.body)
            else {
                continue;
            };
            let place = self.survey.channels.place(message.channel_id);
            if !place.is_some_and(|place| place.topic == Topic::Telegram && place.sensor == self.sensor) {
                continue;
            }
            let Some((header, telegram)) = file::parts(&data) else { continue };
            return Some(Frame {
                telegram: telegram.to_vec(),
                wall_ns: Some(header.wall_ns),
                header: Some(header),
            });
        }
    }
}
