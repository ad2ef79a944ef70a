//! The schemas and channels of a file, as its records announce them.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::body::Body;
use super::types::{Channel, MessageSchema};
use crate::error::{DatasetError, Result};

/// Schemas and channels announced so far. A record that comes again must say the same.
#[derive(Debug, Clone, Default)]
pub(super) struct Registry {
    schemas: BTreeMap<u16, Arc<MessageSchema>>,
    /// By id.
    channels: Vec<Arc<Channel>>,
}

impl Registry {
    pub(super) fn new(schemas: &[Arc<MessageSchema>], channels: &[Arc<Channel>]) -> Self {
        Self {
            schemas: schemas.iter().map(|s| (s.id, Arc::clone(s))).collect(),
            channels: channels.to_vec(),
        }
    }

    pub(super) fn channels(&self) -> &[Arc<Channel>] {
        &self.channels
    }

    pub(super) fn schemas(&self) -> impl ExactSizeIterator<Item = &Arc<MessageSchema>> {
        self.schemas.values()
    }

    /// Place of a channel in [`Self::channels`].
    pub(super) fn place(&self, id: u16) -> Option<usize> {
        self.channels
            .binary_search_by_key(&id, |channel| channel.id)
            .ok()
    }

    /// Takes in a schema record; its id.
    pub(super) fn add_schema(&mut self, bytes: &[u8], offset: u64) -> Result<u16> {
        let mut body = Body::new(bytes, "schema record", offset);
        let schema = MessageSchema {
            id: body.u16()?,
            name: body.text()?,
            encoding: body.text()?,
            data: body.sized()?.to_vec(),
        };
        if schema.id == 0 {
            return Err(body.error("has id 0, which stands for no schema"));
        }
        match self.schemas.get(&schema.id) {
            Some(known) if **known != schema => Err(DatasetError::corrupt(format!(
                "schema {} (\"{}\") is defined again, differently, at offset {offset} (\"{}\")",
                schema.id, known.name, schema.name
            ))),
            Some(_) => Ok(schema.id),
            None => {
                let id = schema.id;
                self.schemas.insert(id, Arc::new(schema));
                Ok(id)
            }
        }
    }

    /// Takes in a channel record; its id, and its place if it is new.
    pub(super) fn add_channel(
        &mut self,
        bytes: &[u8],
        offset: u64,
    ) -> Result<(u16, Option<usize>)> {
        let mut body = Body::new(bytes, "channel record", offset);
        let id = body.u16()?;
        let schema_id = body.u16()?;
        let topic = body.text()?;
        let message_encoding = body.text()?;
        let metadata = body.text_map()?;
        let schema = match schema_id {
            0 => None,
            schema_id => Some(self.schemas.get(&schema_id).cloned().ok_or_else(|| {
                body.error(&format!(
                    "(\"{topic}\") names schema {schema_id}, which is not defined before it"
                ))
            })?),
        };
        let channel = Channel {
            id,
            topic,
            message_encoding,
            metadata,
            schema,
        };
        match self.channels.binary_search_by_key(&id, |known| known.id) {
            Err(place) => {
                self.channels.insert(place, Arc::new(channel));
                Ok((id, Some(place)))
            }
            Ok(place) => match self.channels.get(place) {
                Some(known) if **known != channel => Err(DatasetError::corrupt(format!(
                    "channel {id} (\"{}\") is defined again, differently, at offset {offset} (\"{}\")",
                    known.topic, channel.topic
                ))),
                _ => Ok((id, None)),
            },
        }
    }
}
