//! Requests out of JSON and queries, by the descriptors of their messages.

use futures::{Stream, stream};
use http::{Method, request::Parts};
use http_body_util::{BodyExt, Limited};
use prost_reflect::{
    DescriptorError, DescriptorPool, DynamicMessage, FieldDescriptor, Kind, MessageDescriptor,
    MethodDescriptor, ServiceDescriptor,
};
use serde_json::{Map, Value};
use tonic::{Status, body::Body};

use super::fault::{Fault, Result};
use crate::service::proto::DESCRIPTORS;

/// Bytes of a body in JSON.
const MAX_BODY: usize = 1 << 20;

/// The messages of the public API.
#[derive(Debug)]
pub(in crate::service) struct Shapes {
    pool: DescriptorPool,
    service: Option<ServiceDescriptor>,
}

impl Shapes {
    pub fn read() -> std::result::Result<Self, DescriptorError> {
        let pool = DescriptorPool::decode(DESCRIPTORS)?;
        let service = pool.get_service_by_name("lookalike.v1.LookalikeService");
        Ok(Self { pool, service })
    }

    pub fn method(&self, name: &str) -> Option<MethodDescriptor> {
        self.service.as_ref()?.methods().find(|method| method.name() == name)
    }

    /// A message of its own type as JSON.
    pub fn json<M: prost::Message>(
        &self,
        name: &str,
        message: &M,
    ) -> std::result::Result<Value, Status> {
        let internal = |text: String| Status::internal(text);
        let shape = self.pool.get_message_by_name(name).ok_or_else(|| internal(name.into()))?;
        let mut dynamic = DynamicMessage::new(shape);
        dynamic.transcode_from(message).map_err(|error| internal(error.to_string()))?;
        serde_json::to_value(&dynamic).map_err(|error| internal(error.to_string()))
    }

    /// An entry of a log.
    pub fn event(&self) -> Option<MessageDescriptor> {
        self.pool.get_message_by_name("lookalike.v1.JobEvent")
    }

    /// What the query of an upload says.
    pub fn upload_header(&self) -> Option<MessageDescriptor> {
        self.pool.get_message_by_name("lookalike.v1.UploadMeshHeader")
    }
}

/// Fields that the path gives.
pub(super) type Fixed = Vec<(String, String)>;

/// The message that a request carries, in its body or in its query. It is read when it is asked for: not before
/// the gate has let the call in.
pub(super) fn request(
    (shape, fixed): (MessageDescriptor, Fixed),
    parts: &Parts,
    body: Body,
) -> impl Stream<Item = Result<DynamicMessage>> + Send + 'static {
    let query = parts.uri.query().map(str::to_owned);
    let has_body = parts.method == Method::POST;
    stream::once(async move {
        if has_body {
            from_body(shape, body, fixed).await
        } else {
            from_query(shape, query.as_deref(), fixed)
        }
    })
}

async fn from_body(shape: MessageDescriptor, body: Body, fixed: Fixed) -> Result<DynamicMessage> {
    let text = Limited::new(body, MAX_BODY).collect().await;
    let text = text.map_err(|error| Fault::invalid("body", format!("{error}: send it again")))?;
    let text = text.to_bytes();
    let mut message = if text.is_empty() {
        DynamicMessage::new(shape)
    } else {
        let mut json = serde_json::Deserializer::from_slice(&text);
        let message = DynamicMessage::deserialize(shape, &mut json);
        let message = message.and_then(|message| json.end().map(|()| message));
        message.map_err(|error| Fault::invalid("body", error.to_string()))?
    };
    for (field, value) in fixed {
        message.set_field_by_name(&field, prost_reflect::Value::String(value));
    }
    Ok(message)
}

/// A message out of `a=1&b=2`; fields by either of their names, lists by repetition.
pub(super) fn from_query(
    shape: MessageDescriptor,
    query: Option<&str>,
    fixed: Fixed,
) -> Result<DynamicMessage> {
    let mut object = Map::new();
    for (key, text) in form_urlencoded::parse(query.unwrap_or_default().as_bytes()) {
        let field = shape.get_field_by_name(&key).or_else(|| shape.get_field_by_json_name(&key));
        let field = field.filter(|field| fixed.iter().all(|(fixed, _)| fixed != field.name()));
        let field = field.ok_or_else(|| unknown(&shape, &key, &fixed))?;
        add(&mut object, &field, &text)?;
    }
    object.extend(fixed.into_iter().map(|(field, value)| (field, Value::String(value))));
    DynamicMessage::deserialize(shape, Value::Object(object))
        .map_err(|error| Fault::invalid("query", error.to_string()))
}

fn unknown(shape: &MessageDescriptor, key: &str, fixed: &Fixed) -> Fault {
    let names = shape.fields().map(|field| field.name().to_owned());
    let names: Vec<_> = names.filter(|name| fixed.iter().all(|(fixed, _)| fixed != name)).collect();
    let names = if names.is_empty() { "none".into() } else { names.join(", ") };
    let key: String = key.chars().take(64).collect();
    Fault::invalid(
        "query",
        format!("`{}` is no parameter here: there are {names}", key.escape_default()),
    )
}

fn add(object: &mut Map<String, Value>, field: &FieldDescriptor, text: &str) -> Result<()> {
    let value = match field.kind() {
        Kind::Bool => {
            let value =
                text.parse().map_err(|_| Fault::invalid(field.name(), "use true or false"))?;
            Value::Bool(value)
        }
        // Numbers, too, are read from texts.
        _ => Value::String(text.into()),
    };
    let old = object.remove(field.name());
    let value = match (field.is_list(), old) {
        (false, None) => value,
        (true, Some(Value::Array(mut list))) => {
            list.push(value);
            Value::Array(list)
        }
        (true, _) => Value::Array(vec![value]),
        (false, Some(_)) => return Err(Fault::invalid(field.name(), "it is given twice")),
    };
    object.insert(field.name().into(), value);
    Ok(())
}

/// The same message by its own type.
pub(super) fn typed<M: prost::Message + Default>(message: &DynamicMessage) -> Result<M> {
    message.transcode_to().map_err(unreadable)
}

/// Only where the descriptors are not those of the messages.
pub(super) fn unreadable(error: prost::DecodeError) -> Fault {
    Fault::new(tonic::Code::Internal, "DESCRIPTORS", &error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::proto::v1;

    fn list(query: &str) -> std::result::Result<v1::ListJobsRequest, String> {
        let shape = Shapes::read().unwrap().method("ListJobs").unwrap().input();
        let message = from_query(shape, Some(query), Fixed::new());
        let message = message.map_err(|fault| format!("{fault:?}"))?;
        Ok(typed(&message).unwrap())
    }

    #[test]
    fn queries_are_read_by_the_descriptors() {
        let wanted = v1::ListJobsRequest {
            page_size: 7,
            page_token: "a+b".into(),
            states: vec![v1::JobState::Queued.into(), v1::JobState::Failed.into()],
            owner: "Ännchen".into(),
            labels: vec!["batch=7".into(), "kind=tree".into()],
            create_time_from: Some(prost_types::Timestamp { seconds: 1_700_000_000, nanos: 0 }),
            create_time_until: None,
        };
        let states = "states=JOB_STATE_QUEUED&states=JOB_STATE_FAILED";
        for names in ["page_size=7&page_token=", "pageSize=7&pageToken="] {
            let query = format!(
                "{names}a%2Bb&{states}&owner=%C3%84nnchen&labels=batch%3D7&labels=kind%3Dtree\
                 &create_time_from=2023-11-14T22:13:20Z"
            );
            assert_eq!(list(&query), Ok(wanted.clone()), "{query}");
        }
        for (bad, fault) in [
            ("page_size=x", "invalid"),
            ("page_size=-1", "invalid"),
            ("states=NONE", "NONE"),
            ("owner=a&owner=b", "given twice"),
            ("create_time_from=yesterday", "invalid date"),
            ("colour=red", "page_size, page_token, states, owner"),
        ] {
            let found = list(bad).unwrap_err();
            assert!(found.contains(fault), "{bad}: {found}");
        }
    }

    #[tokio::test]
    async fn bodies_are_read_strictly_and_the_path_wins() {
        let shape = Shapes::read().unwrap().method("DeleteJob").unwrap().input();
        let read = async |text: &str| {
            let body = Body::new(http_body_util::Full::from(text.to_owned()));
            let fixed = vec![("name".to_owned(), "jobs/1".to_owned())];
            let message = from_body(shape.clone(), body, fixed).await;
            message.map(|message| typed::<v1::DeleteJobRequest>(&message).unwrap())
        };
        let wanted = |allow_missing| v1::DeleteJobRequest { name: "jobs/1".into(), allow_missing };
        assert_eq!(read("").await.unwrap(), wanted(false));
        assert_eq!(
            read(r#"{"allowMissing": true, "name": "jobs/2"}"#).await.unwrap(),
            wanted(true)
        );
        for bad in
            ["[]", "{", "{} {}", r#"{"colour": 1}"#, &"[".repeat(1000), &" ".repeat(MAX_BODY + 1)]
        {
            assert!(read(bad).await.is_err(), "{bad:.20}");
        }
    }
}
