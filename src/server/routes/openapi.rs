//! The OpenAPI document of the HTTP routes. `protocol/openapi.json` is written by the test below,
//! from the table of routes and from `protocol/schema`, which other tests write from the protocol's
//! types.

use axum::http::header;
use axum::response::IntoResponse;

const DOCUMENT: &str = include_str!("../../../protocol/openapi.json");

/// The handler of `GET /v1/openapi.json`.
pub(super) async fn show() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], DOCUMENT)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs;
    use std::path::{Path, PathBuf};

    use serde_json::{Map, Value, json};

    use crate::auth::{Access, Role};

    use super::super::table::{self, Content, Kind, Method, Operation, Parameter};

    fn protocol() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../protocol")
    }

    /// The schemas of all bodies. The definitions of each file become schemas of the document.
    #[derive(Default)]
    struct Schemas(BTreeMap<String, Value>);

    /// Prefix of the schemas of requests: they refuse unknown fields, and those of answers do not.
    const OF_REQUESTS: &str = "Request.";

    impl Schemas {
        /// A reference to a file of `protocol/schema`, or to one of its definitions:
        /// `answer#TwinInfo`.
        fn reference(&mut self, prefix: &str, name: &str) -> Value {
            let (file, definition) =
                name.split_once('#').map_or((name, None), |(a, b)| (a, Some(b)));
            let path = protocol().join(format!("schema/{file}.json"));
            let mut schema: Value = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
            let own = schema.as_object_mut().unwrap();
            own.remove("$schema");
            let definitions = own.remove("$defs").unwrap_or_else(|| json!({}));
            let title = own["title"].as_str().unwrap().to_owned();
            let wanted = definition.unwrap_or(&title).to_owned();
            if definition.is_none() {
                self.add(prefix, &title, schema, &definitions);
            } else {
                self.add(prefix, &wanted, definitions[&wanted].clone(), &definitions);
            }
            json!({ "$ref": format!("#/components/schemas/{prefix}{wanted}") })
        }

        /// Adds a schema, and the definitions that it refers to.
        fn add(&mut self, prefix: &str, name: &str, mut schema: Value, definitions: &Value) {
            let mut named = Vec::new();
            rename(prefix, &mut schema, &mut named);
            // A schema that is there already has its definitions, too. This also ends a schema that
            // refers to itself.
            if let Some(before) = self.0.insert(format!("{prefix}{name}"), schema.clone()) {
                assert_eq!(before, schema, "two schemas are called {prefix}{name}");
                return;
            }
            for name in named {
                self.add(prefix, &name, definitions[&name].clone(), definitions);
            }
        }
    }

    /// Lets references lead to the document's schemas, and collects their names. Says how large
    /// integers may be, which JSON Schema's formats do not.
    fn rename(prefix: &str, schema: &mut Value, named: &mut Vec<String>) {
        match schema {
            Value::Object(fields) => {
                if fields.get("format").is_some_and(|format| format == "uint64") {
                    fields.insert("maximum".to_owned(), u64::MAX.into());
                }
                for (key, value) in fields {
                    let definition = value.as_str().and_then(|text| text.strip_prefix("#/$defs/"));
                    if let (true, Some(name)) = (key == "$ref", definition.map(str::to_owned)) {
                        *value = format!("#/components/schemas/{prefix}{name}").into();
                        named.push(name);
                    } else {
                        rename(prefix, value, named);
                    }
                }
            }
            Value::Array(values) => {
                values.iter_mut().for_each(|value| rename(prefix, value, named))
            }
            _ => {}
        }
    }

    fn content(prefix: &str, content: Content, schemas: &mut Schemas) -> Option<Value> {
        let json = |schema: Value| json!({ "application/json": { "schema": schema } });
        Some(match content {
            Content::None => return None,
            Content::Json(name) => json(schemas.reference(prefix, name)),
            Content::List(field, name) => {
                let list = json!({ "type": "array", "items": schemas.reference(prefix, name) });
                json(
                    json!({ "type": "object", "properties": { field: list }, "required": [field] }),
                )
            }
            Content::Object => json(json!({ "type": "object" })),
            Content::Media(media_type) => json!({ media_type: {} }),
        })
    }

    fn parameters(operation: &Operation) -> Vec<Value> {
        // The parts after each `{`, up to their `}`.
        let in_path = operation.path.split('{').skip(1).map(|rest| rest.split('}').next().unwrap());
        let in_path = in_path.map(|name| {
            // A trajectory may have any name.
            let mut schema = json!({ "type": "string" });
            if name != "name" {
                schema["pattern"] = wildcity_protocol::message::NAME_PATTERN.into();
            }
            json!({ "name": name, "in": "path", "required": true, "schema": schema })
        });
        let others = operation.parameters.iter().map(|parameter| {
            let Parameter { name, place, kind, is_required, description } = parameter;
            let most = u64::MAX;
            let schema = match kind {
                Kind::Count => json!({ "type": "integer", "minimum": 0, "maximum": most }),
                Kind::Number => json!({ "type": "number" }),
                Kind::Length => json!({ "type": "number", "exclusiveMinimum": 0 }),
                Kind::Text => json!({ "type": "string" }),
            };
            json!({ "name": name, "in": place, "required": is_required, "description": description,
                    "schema": schema })
        });
        in_path.chain(others).collect()
    }

    fn described(operation: &Operation, schemas: &mut Schemas) -> Value {
        let mut answer = |description: &str, kind: Content| {
            // An answer to HEAD has the status and the headers alone.
            let kind = if operation.method == Method::Head { Content::None } else { kind };
            let mut answer = json!({ "description": description });
            if let Some(content) = content("", kind, schemas) {
                answer["content"] = content;
            }
            answer
        };
        let success = answer("Success.", operation.answer);
        let mut answers = Map::from_iter([(operation.success.to_string(), success)]);
        let refusal = Content::Json("refusal");
        for &(status, description) in operation.others {
            let kind = if status < 300 { operation.answer } else { refusal };
            let before = answers.insert(status.to_string(), answer(description, kind));
            assert!(before.is_none(), "{status} of {}", operation.path);
        }
        if operation.access != Access::Public {
            let description = "Refused; nothing changed.";
            answers.insert("default".to_owned(), answer(description, refusal));
        }
        let role = match operation.access {
            Access::Public => String::new(),
            Access::AnyToken => "Any token, except those with the role metrics.".to_owned(),
            Access::Role(Role::Drive) => "Tokens with the role drive, push or admin.".to_owned(),
            Access::Role(role) => format!("Tokens with the role {} or admin.", role.name()),
        };
        let mut described = json!({
            "summary": operation.summary,
            "operationId": id(operation),
            "description": role,
            "parameters": parameters(operation),
            "responses": answers,
        });
        if operation.access != Access::Public {
            // Either nothing or a token: a server without tokens takes the requests, too.
            described["security"] = json!([{}, { "token": [] }]);
        }
        if let Some(content) = content(OF_REQUESTS, operation.body, schemas) {
            described["requestBody"] = json!({ "required": true, "content": content });
        }
        described
    }

    fn verb(method: Method) -> &'static str {
        match method {
            Method::Get => "get",
            Method::Head => "head",
            Method::Post => "post",
            Method::Patch => "patch",
            Method::Delete => "delete",
        }
    }

    /// Id of an operation, such as `get_v1_twins_twin`.
    fn id(operation: &Operation) -> String {
        let words = operation.path.split(|c: char| !c.is_ascii_alphanumeric());
        let words: Vec<&str> = std::iter::once(verb(operation.method))
            .chain(words.filter(|word| !word.is_empty()))
            .collect();
        words.join("_")
    }

    fn operations() -> Vec<Operation> {
        table::rows().iter().map(|row| row.operation).collect()
    }

    fn document() -> Value {
        let mut schemas = Schemas::default();
        let mut paths: BTreeMap<&str, Map<String, Value>> = BTreeMap::new();
        for operation in operations() {
            let described = described(&operation, &mut schemas);
            let known = paths.entry(operation.path).or_default();
            assert!(known.insert(verb(operation.method).to_owned(), described).is_none());
        }
        json!({
            "openapi": "3.1.0",
            "info": {
                "title": "wildcity",
                "version": env!("CARGO_PKG_VERSION"),
                "description": "HTTP routes of the simulator. Sessions are driven over a WebSocket, which protocol/README.md describes.",
                "license": { "name": "MIT OR Apache-2.0", "identifier": "MIT OR Apache-2.0" },
            },
            "servers": [{ "url": "/" }],
            "paths": paths,
            "components": {
                "schemas": schemas.0,
                "securitySchemes": { "token": { "type": "http", "scheme": "bearer" } },
            },
        })
    }

    /// `WILDCITY_BLESS=1` writes the document instead.
    #[test]
    fn the_document_is_that_of_the_routes() {
        let text = format!("{:#}\n", document());
        let test = "-p wildcity-server --lib openapi";
        crate::generated::check("protocol/openapi.json", &text, test);
    }

    #[test]
    fn every_route_is_on_the_page_of_the_protocol() {
        let page = fs::read_to_string(protocol().join("README.md")).unwrap();
        let table =
            page.split("\n| route | role | answer |").nth(1).unwrap().split("\n\n").next().unwrap();
        for operation in operations() {
            if operation.path == "/v1/session" {
                continue;
            }
            // The page writes `ID` for `{id}`, and `T` for `{twin}`.
            let segments = operation.path.split('/').map(|segment| match segment {
                "{id}" => "ID".to_owned(),
                _ => match segment.strip_prefix('{') {
                    Some(name) => name[..1].to_ascii_uppercase(),
                    None => segment.to_owned(),
                },
            });
            let path = segments.collect::<Vec<_>>().join("/");
            let method = verb(operation.method).to_ascii_uppercase();
            let role = match operation.access {
                Access::Public => "",
                Access::AnyToken => "any",
                Access::Role(role) => role.name(),
            };
            let listed = table.lines().any(|line| {
                let cells: Vec<&str> = line.split('|').map(str::trim).collect();
                // The first line ends the one of the heading, and is empty.
                let [_, route, its_role, ..] = cells[..] else { return false };
                route.contains(&method) && route.contains(&format!("{path}`")) && its_role == role
            });
            assert!(listed, "{method} {path} with the role {role:?} is not on the page");
        }
    }
}
