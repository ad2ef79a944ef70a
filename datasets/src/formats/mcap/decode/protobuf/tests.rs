use prost_reflect::DescriptorPool;
use prost_reflect::prost_types::field_descriptor_proto::{Label, Type};
use prost_reflect::prost_types::{
    DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet,
};

use super::{MessageType, ProtobufPlan};
use crate::error::DatasetError;
use crate::formats::mcap::decode::{Extracted, FieldPath, Value};

fn field(name: &str, number: i32, of: Type, type_name: &str) -> FieldDescriptorProto {
    let (label, name) = match name.strip_suffix("[]") {
        Some(name) => (Label::Repeated, name),
        None => (Label::Optional, name),
    };
    FieldDescriptorProto {
        name: Some(name.to_owned()),
        number: Some(number),
        label: Some(label.into()),
        r#type: Some(of.into()),
        type_name: (!type_name.is_empty()).then(|| type_name.to_owned()),
        ..Default::default()
    }
}

fn file(name: &str, package: &str, imports: &[&str]) -> FileDescriptorProto {
    FileDescriptorProto {
        name: Some(name.to_owned()),
        package: Some(package.to_owned()),
        dependency: imports.iter().map(|&name| name.to_owned()).collect(),
        syntax: Some("proto3".to_owned()),
        ..Default::default()
    }
}

fn message(name: &str, fields: Vec<FieldDescriptorProto>) -> DescriptorProto {
    DescriptorProto {
        name: Some(name.to_owned()),
        field: fields,
        ..Default::default()
    }
}

fn top() -> MessageType {
    let mut time = file("google/protobuf/timestamp.proto", "google.protobuf", &[]);
    time.message_type = vec![message(
        "Timestamp",
        vec![
            field("seconds", 1, Type::Int64, ""),
            field("nanos", 2, Type::Int32, ""),
        ],
    )];
    let mut own = file("top.proto", "pkg", &["google/protobuf/timestamp.proto"]);
    own.message_type = vec![
        message(
            "Top",
            vec![
                field("xs[]", 1, Type::Double, ""),
                field("items[]", 2, Type::Message, ".pkg.Inner"),
                field("one", 3, Type::Message, ".pkg.Inner"),
                field("s", 4, Type::String, ""),
                field("z", 5, Type::Sint64, ""),
                field("f", 6, Type::Fixed32, ""),
                field("b", 7, Type::Bytes, ""),
                field("names[]", 8, Type::String, ""),
                field("u", 9, Type::Uint64, ""),
                field("t", 10, Type::Message, ".google.protobuf.Timestamp"),
                field("i", 11, Type::Int32, ""),
                field("counts[]", 12, Type::Int32, ""),
            ],
        ),
        message(
            "Inner",
            vec![
                field("v", 1, Type::Double, ""),
                field("name", 2, Type::String, ""),
                field("child", 3, Type::Message, ".pkg.Inner"),
            ],
        ),
    ];
    let set = FileDescriptorSet {
        file: vec![time, own],
    };
    let pool = DescriptorPool::from_file_descriptor_set(set).unwrap();
    MessageType::new("pkg.Top", &pool.encode_to_vec()).unwrap()
}

fn bytes(number: u8, content: &[u8]) -> Vec<u8> {
    let length = u8::try_from(content.len()).unwrap();
    assert!(length < 128);
    [&[number << 3 | 2, length], content].concat()
}

fn double(number: u8, value: f64) -> Vec<u8> {
    [&[number << 3 | 1][..], &value.to_le_bytes()].concat()
}

fn varint(number: u8, mut value: u64) -> Vec<u8> {
    let mut found = vec![number << 3];
    while value >= 0x80 {
        found.push(value as u8 | 0x80);
        value >>= 7;
    }
    found.push(value as u8);
    found
}

fn extract(data: &[u8], paths: &[&str]) -> Result<Extracted, String> {
    let paths: Vec<FieldPath> = paths.iter().map(|path| path.parse().unwrap()).collect();
    let plan = ProtobufPlan::new(&top(), &paths).unwrap();
    let mut out = Extracted::default();
    let (slots, counters) = out.start(paths.len(), plan.n_counters());
    plan.extract(data, slots, counters)
        .map_err(|fault| fault.into_text())?;
    Ok(out)
}

fn decode(data: &[u8]) -> Value {
    top().decode(data).unwrap()
}

#[test]
fn lists_come_packed_or_not() {
    let packed = [1.0_f64.to_le_bytes(), 2.0_f64.to_le_bytes()].concat();
    let counts = bytes(
        12,
        &[3, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 1],
    );
    let data = [bytes(1, &packed), double(1, 3.0), counts, varint(12, 5)].concat();
    let out = extract(&data, &["xs", "xs[2]", "xs[3]", "counts"]).unwrap();
    assert_eq!(out.slots()[0].numbers(), [1.0, 2.0, 3.0]);
    assert_eq!(out.slots()[1].numbers(), [3.0]);
    assert!(!out.slots()[2].present());
    assert_eq!(out.slots()[3].numbers(), [3.0, -1.0, 5.0]);
    let list = |values: &[i64]| Value::List(values.iter().map(|&v| Value::Int(v)).collect());
    assert_eq!(decode(&data).member("counts"), Some(&list(&[3, -1, 5])));
}

#[test]
fn what_comes_again_replaces_or_completes() {
    let data = [
        bytes(3, &double(1, 1.0)),
        bytes(3, &bytes(2, b"a")),
        bytes(3, &[bytes(2, b"bc"), bytes(3, &double(1, 2.0))].concat()),
        bytes(4, b"first"),
        bytes(4, b"last"),
        varint(11, 1),
        varint(11, u64::MAX),
    ]
    .concat();
    let paths = [
        "one.v",
        "one.name",
        "one.child.v",
        "one.child.name",
        "s",
        "i",
    ];
    let out = extract(&data, &paths).unwrap();
    let texts = |slot: usize| out.slots()[slot].texts().collect::<Vec<_>>();
    assert_eq!(out.slots()[0].numbers(), [1.0]);
    assert_eq!(texts(1), ["bc"]);
    assert_eq!(out.slots()[2].numbers(), [2.0]);
    assert_eq!(texts(3), [""]);
    assert_eq!(texts(4), ["last"]);
    assert_eq!(out.slots()[5].numbers(), [-1.0]);
    let tree = decode(&data);
    assert_eq!(tree.member("i"), Some(&Value::Int(-1)));
    let one = tree.member("one").unwrap();
    assert_eq!(one.member("v"), Some(&Value::Float64(1.0)));
    assert_eq!(one.member("name"), Some(&Value::Text("bc".to_owned())));
}

#[test]
fn members_of_elements_stay_in_line() {
    let with_child = [bytes(2, b"x"), bytes(3, &double(1, 5.0))].concat();
    let twice = [
        double(1, 7.0),
        double(1, 8.0),
        bytes(2, b"y"),
        bytes(2, b"z"),
    ]
    .concat();
    let data = [
        bytes(2, &double(1, 1.0)),
        bytes(2, &with_child),
        bytes(2, &twice),
    ]
    .concat();
    let paths = [
        "items[].v",
        "items[].name",
        "items[].child.v",
        "items[2].v",
        "items[3].v",
    ];
    let out = extract(&data, &paths).unwrap();
    assert_eq!(out.slots()[0].numbers(), [1.0, 0.0, 8.0]);
    assert_eq!(out.slots()[1].texts().collect::<Vec<_>>(), ["", "x", "z"]);
    let child = out.slots()[2].numbers();
    assert!(child[0].is_nan() && child[1] == 5.0 && child[2].is_nan());
    assert_eq!(out.slots()[3].numbers(), [8.0]);
    assert!(!out.slots()[4].present());
    let none = extract(&[], &["items[].v"]).unwrap();
    assert!(none.slots()[0].present() && none.slots()[0].numbers().is_empty());
}

#[test]
fn unset_is_the_default_or_absent() {
    let paths = ["s", "z", "f", "b", "one.v", "t", "names", "xs"];
    let out = extract(&[], &paths).unwrap();
    let present: Vec<bool> = out.slots().iter().map(|slot| slot.present()).collect();
    assert_eq!(present, [true, true, true, true, false, false, true, true]);
    assert_eq!(out.slots()[0].texts().collect::<Vec<_>>(), [""]);
    assert_eq!(out.slots()[1].numbers(), [0.0]);
    assert_eq!(decode(&[]).member("one"), Some(&Value::Null));
    assert_eq!(decode(&[]).member("z"), Some(&Value::Int(0)));
}

#[test]
fn numbers_and_times() {
    let time = [varint(1, 5), varint(2, 7)].concat();
    let data = [
        varint(5, 5),
        vec![6 << 3 | 5, 1, 0, 0, 128],
        varint(9, 1 << 53),
        bytes(10, &time),
    ];
    let out = extract(&data.concat(), &["z", "f", "u", "t", "t.nanos"]).unwrap();
    assert_eq!(out.slots()[0].numbers(), [-3.0]);
    assert_eq!(out.slots()[1].numbers(), [2_147_483_649.0]);
    assert_eq!(out.slots()[2].numbers(), [9_007_199_254_740_992.0]);
    assert_eq!(out.slots()[3].time_ns(), Some(5_000_000_007));
    assert_eq!(out.slots()[4].numbers(), [7.0]);
    let beyond = varint(9, (1 << 53) + 1);
    assert!(extract(&beyond, &["u"]).unwrap_err().contains("2^53"));
    let zero = extract(&bytes(10, &[]), &["t"]).unwrap();
    assert!(!zero.slots()[0].present());
}

#[test]
fn damaged_messages_are_refused() {
    for data in [
        vec![4 << 3 | 2, 100, b'a'],
        vec![5 << 3, 0xFF],
        [vec![5 << 3], vec![0xFF; 11]].concat(),
        vec![0, 0],
        vec![4 << 3 | 2, 1, 0xFF],
        varint(4, 1),
        vec![20 << 3 & 0x7F | 7],
        [0xA3, 1].repeat(200),
    ] {
        assert!(extract(&data, &["s", "z"]).is_err(), "{data:?}");
    }
    // Groups and fields that are not known are passed over.
    let known = [vec![0xA3, 1, 0xA8, 1, 1, 0xA4, 1], varint(15, 3)].concat();
    assert!(extract(&known, &["z"]).is_ok());
}

#[test]
fn paths_and_schemas_that_do_not_fit_are_refused() {
    let plan = |path: &str| ProtobufPlan::new(&top(), &[path.parse().unwrap()]);
    for path in ["nothing", "one.nothing", "items[].nothing"] {
        let error = plan(path).unwrap_err();
        assert!(
            matches!(error, DatasetError::MissingKey { .. }),
            "{path}: {error}"
        );
    }
    for path in ["one", "items", "items[0]", "s[0]", "xs.v", "b[0]"] {
        let error = plan(path).unwrap_err();
        assert!(
            matches!(error, DatasetError::WrongType { .. }),
            "{path}: {error}"
        );
    }
    for (name, data) in [("pkg.Top", &b"\x0a\xff"[..]), ("pkg.Other", &[])] {
        let error = MessageType::new(name, data).unwrap_err();
        assert!(matches!(error, DatasetError::Corrupt { .. }), "{error}");
    }
}
