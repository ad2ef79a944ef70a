use std::sync::Arc;

use super::parse::parse;
use super::plan::RosPlan;
use super::types::{Flavor, Types};
use crate::error::DatasetError;
use crate::formats::mcap::decode::{Extracted, FieldDescription, FieldPath, Value};

/// Writes CDR by its rules, for comparison.
struct Cdr {
    bytes: Vec<u8>,
    big: bool,
}

impl Cdr {
    fn new(big: bool) -> Self {
        Self {
            bytes: vec![0, u8::from(!big), 0, 0],
            big,
        }
    }

    fn put(mut self, little: &[u8]) -> Self {
        while !(self.bytes.len() - 4).is_multiple_of(little.len()) {
            self.bytes.push(0xEE);
        }
        if self.big {
            self.bytes.extend(little.iter().rev());
        } else {
            self.bytes.extend(little);
        }
        self
    }

    fn u8(self, value: u8) -> Self {
        self.put(&[value])
    }

    fn u16(self, value: u16) -> Self {
        self.put(&value.to_le_bytes())
    }

    fn u32(self, value: u32) -> Self {
        self.put(&value.to_le_bytes())
    }

    fn f64(self, value: f64) -> Self {
        self.put(&value.to_le_bytes())
    }

    fn text(self, text: &str) -> Self {
        let length = u32::try_from(text.len() + 1).unwrap();
        let mut to = self.u32(length);
        to.bytes.extend(text.as_bytes());
        to.bytes.push(0);
        to
    }
}

fn ros2(text: &str) -> Types {
    parse("pkg/msg/Top", text.as_bytes(), Flavor::Ros2).unwrap()
}

fn ros1(text: &str) -> Types {
    parse("pkg/Top", text.as_bytes(), Flavor::Ros1).unwrap()
}

fn parse_error(text: &str) -> DatasetError {
    parse("pkg/msg/Top", text.as_bytes(), Flavor::Ros2).unwrap_err()
}

fn decode(types: &Types, bytes: &[u8]) -> Result<Value, String> {
    super::decode(types, bytes).map_err(|fault| fault.into_text())
}

fn extract(types: &Types, paths: &[&str], bytes: &[u8]) -> Result<Extracted, String> {
    let paths: Vec<FieldPath> = paths.iter().map(|path| path.parse().unwrap()).collect();
    let plan = RosPlan::new(Arc::new(types.clone()), &paths).unwrap();
    let mut out = Extracted::default();
    plan.extract(bytes, out.start(paths.len(), 0).0)
        .map_err(|fault| fault.into_text())?;
    Ok(out)
}

fn names(fields: &[FieldDescription]) -> Vec<&str> {
    fields.iter().map(|field| field.path.as_str()).collect()
}

const MIXED: &str = "uint8 a\nfloat64 b\nuint8 c\nstring d\nuint16 e\nfloat64[] f\nuint32 g\n\
    Inner[] h\nfloat64[2] i\nEmpty j\nuint8 k\n\
    ================================================================================\n\
    MSG: pkg/Inner\nuint8 x\nfloat64 y\n\
    ================================================================================\n\
    MSG: pkg/Empty\n";

fn mixed(big: bool) -> Vec<u8> {
    let cdr = Cdr::new(big).u8(1).f64(2.5).u8(3).text("four").u16(5);
    // An empty array has no elements to be aligned.
    let cdr = cdr.u32(0).u32(7).u32(2).u8(8).f64(8.5).u8(9).f64(9.5);
    cdr.f64(-1.0).f64(f64::INFINITY).u8(0).u8(11).bytes
}

#[test]
fn members_are_aligned_to_their_size_in_both_byte_orders() {
    let types = ros2(MIXED);
    for big in [false, true] {
        let bytes = mixed(big);
        let value = decode(&types, &bytes).unwrap();
        let member = |name: &str| value.member(name).unwrap().clone();
        assert_eq!(member("a"), Value::Uint(1));
        assert_eq!(member("b"), Value::Float64(2.5));
        assert_eq!(member("d"), Value::Text("four".to_owned()));
        assert_eq!(member("e"), Value::Uint(5));
        assert_eq!(member("f"), Value::List(vec![]));
        assert_eq!(member("g"), Value::Uint(7));
        let Value::List(inner) = member("h") else {
            panic!()
        };
        assert_eq!(inner[1].member("y"), Some(&Value::Float64(9.5)));
        assert_eq!(member("k"), Value::Uint(11));

        let paths = ["k", "h[1].y", "h[].x", "h[7].x", "i", "f", "i[1]", "d", "b"];
        let out = extract(&types, &paths, &bytes).unwrap();
        let numbers = |slot: usize| out.slots()[slot].numbers();
        assert_eq!(numbers(0), [11.0]);
        assert_eq!(numbers(1), [9.5]);
        assert_eq!(numbers(2), [8.0, 9.0]);
        assert!(!out.slots()[3].present());
        assert_eq!(numbers(4), [-1.0, f64::INFINITY]);
        assert!(out.slots()[5].present() && numbers(5).is_empty());
        assert_eq!(numbers(6), [f64::INFINITY]);
        assert_eq!(out.slots()[7].texts().collect::<Vec<_>>(), ["four"]);
        assert_eq!(numbers(8), [2.5]);
    }
}

#[test]
fn a_message_that_is_cut_anywhere_is_an_error() {
    let types = ros2(MIXED);
    let bytes = mixed(false);
    for n in 0..bytes.len() {
        assert!(decode(&types, &bytes[..n]).is_err(), "{n} bytes");
        assert!(extract(&types, &["k"], &bytes[..n]).is_err(), "{n} bytes");
    }
    let mut padded = bytes.clone();
    padded.extend([0; 3]);
    assert_eq!(decode(&types, &padded), decode(&types, &bytes));
    padded.extend([0; 20]);
    assert!(decode(&types, &padded).unwrap_err().contains("23 bytes"));
}

#[test]
fn every_integer_type_keeps_its_sign_and_an_inexact_one_is_refused() {
    let types = ros2("int8 a\nint16 b\nint32 c\nint64 d\nuint64 e\nbool f\nfloat32 g\nchar h\n");
    for big in [false, true] {
        let cdr = |d: i64, e: u64| {
            let cdr = Cdr::new(big).put(&(-1_i8).to_le_bytes());
            let cdr = cdr
                .put(&(-2_i16).to_le_bytes())
                .put(&(-3_i32).to_le_bytes());
            let cdr = cdr.put(&d.to_le_bytes()).put(&e.to_le_bytes()).u8(1);
            cdr.put(&0.1_f32.to_le_bytes()).u8(200).bytes
        };
        let paths = ["a", "b", "c", "d", "e", "f", "g", "h"];
        let fine = cdr(-(1 << 53), 1 << 53);
        let out = extract(&types, &paths, &fine).unwrap();
        let found: Vec<f64> = out.slots().iter().map(|s| s.numbers()[0]).collect();
        let exact = (1_u64 << 53) as f64;
        let expected = [
            -1.0,
            -2.0,
            -3.0,
            -exact,
            exact,
            1.0,
            f64::from(0.1_f32),
            200.0,
        ];
        assert_eq!(found, expected);
        assert_eq!(
            decode(&types, &fine).unwrap().member("g"),
            Some(&Value::Float32(0.1))
        );
        let beyond = cdr(-(1 << 53) - 1, (1 << 53) + 1);
        assert!(
            extract(&types, &["d"], &beyond)
                .unwrap_err()
                .contains("2^53")
        );
        assert!(
            extract(&types, &["e"], &beyond)
                .unwrap_err()
                .contains("2^53")
        );
        // It is only wanted as a number that it cannot be.
        assert!(extract(&types, &["a", "h"], &beyond).is_ok());
        let value = decode(&types, &beyond).unwrap();
        assert_eq!(value.member("e"), Some(&Value::Uint((1 << 53) + 1)));
    }
}

#[test]
fn bounds_hold() {
    let types = ros2("string<=3 a\nfloat64[<=2] b\nstring<=2[<=1] c\n");
    let good = Cdr::new(false).text("abc").u32(1).f64(1.0).u32(0).bytes;
    assert!(decode(&types, &good).is_ok());
    let long = Cdr::new(false).text("abcd").u32(0).u32(0).bytes;
    assert_eq!(
        decode(&types, &long).unwrap_err(),
        "a: a text of 4 bytes, at most 3 are allowed"
    );
    let many = Cdr::new(false).text("").u32(3).f64(0.0).f64(0.0).f64(0.0);
    assert_eq!(
        extract(&types, &["b"], &many.bytes)
            .map(|_| ())
            .unwrap_err(),
        "b: 3 values, at most 2 are allowed"
    );
    let deep = Cdr::new(false).text("").u32(0).u32(1).text("abc").bytes;
    assert!(decode(&types, &deep).unwrap_err().contains("at most 2"));
}

#[test]
fn hostile_lengths_are_refused_before_anything_is_allocated() {
    let types = ros2(
        "float64[] a\nstring b\nInner[] c\nuint8 d\n\
        ================================================================================\n\
        MSG: pkg/Inner\nstring[] s\nEmpty e\n\
        ================================================================================\n\
        MSG: pkg/Empty\n",
    );
    for bytes in [
        Cdr::new(false).u32(u32::MAX).bytes,
        Cdr::new(false).u32(0).u32(u32::MAX).bytes,
        Cdr::new(false).u32(0).u32(0).u32(u32::MAX).bytes,
        Cdr::new(false).u32(0).u32(0).u32(1).u32(u32::MAX).bytes,
    ] {
        assert!(decode(&types, &bytes).is_err());
        assert!(extract(&types, &["d"], &bytes).is_err());
    }
    let text = Cdr::new(false)
        .u32(0)
        .u32(3)
        .u8(b'a')
        .u8(b'b')
        .u8(b'c')
        .bytes;
    assert!(decode(&types, &text).unwrap_err().contains("NUL"));
    let text = Cdr::new(false).u32(0).u32(2).u8(0xFF).u8(0).bytes;
    assert!(decode(&types, &text).unwrap_err().contains("UTF-8"));
    // Fixed arrays whose size is in the schema.
    let huge = ros2("float64[18446744073709551615] a\nuint8 b\n");
    let bytes = Cdr::new(false).f64(0.0).bytes;
    assert!(decode(&huge, &bytes).is_err());
    assert!(extract(&huge, &["b"], &bytes).is_err());
}

/// In ROS 1 a type may take no bytes: no number of them may take time or memory.
#[test]
fn types_without_bytes_do_not_multiply() {
    let line = "=".repeat(80);
    let mut text = "T0[1000] a\nT0[] b\n".to_owned();
    for i in 0..30 {
        let next = i + 1;
        text += &format!("{line}\nMSG: pkg/T{i}\nT{next}[1000] a\nT{next} b\nT{next} c\n");
    }
    text += &format!("{line}\nMSG: pkg/T30\nuint8 CONSTANT=3\n");
    let types = ros1(&text);
    assert_eq!(types.describe(), []);
    assert!(decode(&types, &u32::MAX.to_le_bytes()).is_err());
    let value = decode(&ros1(&text.replacen("[1000] a", " a", 1)), &[0; 4]).unwrap();
    assert_eq!(value.member("b"), Some(&Value::List(vec![])));
}

#[test]
fn other_encapsulations_and_wide_texts_are_refused() {
    let types = ros2("uint8 a\n");
    for head in [[0, 2, 0, 0], [0, 7, 0, 0], [1, 1, 0, 0]] {
        let bytes = [head.as_slice(), &[5]].concat();
        assert!(
            decode(&types, &bytes)
                .unwrap_err()
                .contains("encapsulation")
        );
    }
    assert!(matches!(
        parse_error("wstring a\n"),
        DatasetError::Unsupported { .. }
    ));
}

#[test]
fn a_struct_without_members_takes_a_byte_which_may_be_missing_at_the_end() {
    let types = ros2("# std_msgs/Empty\n");
    assert_eq!(decode(&types, &[0, 1, 0, 0, 0]), Ok(Value::Struct(vec![])));
    assert_eq!(decode(&types, &[0, 1, 0, 0]), Ok(Value::Struct(vec![])));
}

#[test]
fn definitions_are_read_with_all_their_oddities() {
    let text = "\u{feff}# A comment\r\n\
        int32 X=5\r\n\
        string HASH=a # b = c\r\n\
        string EQUAL= \"=\"\n\
        \tuint8\t tabbed\t# with a comment\n\
        string quoted \"a # in a text\"\n\
        int32[] numbers [1, 2, 3] # of steps\n\
        float64 w 1\n\
        float64[<=3] bounded\n\
        string<=5[2] short#er\n\
        Point near\n\
        other_msgs/msg/Point far\n\
        Header header\n\
        ================================================================================\n\
        \n\
        MSG: pkg/Point\n\
        float64 x 0.0\n\
        ================================================================================\n\
        MSG: other_msgs/msg/Point\n\
        uint8[4] rgba\n";
    // A line of `=` that is too short is no border.
    let short = text.replace(&"=".repeat(80), &"=".repeat(79));
    assert!(matches!(parse_error(&short), DatasetError::Corrupt { .. }));
    let fields = ros2(text).describe();
    assert_eq!(
        names(&fields),
        [
            "tabbed",
            "quoted",
            "numbers",
            "w",
            "bounded",
            "short",
            "near.x",
            "far.rgba",
            "header.stamp",
            "header.frame_id"
        ]
    );
}

#[test]
fn bad_definitions_are_refused() {
    for text in [
        "float64\n",
        "float64 x-y\n",
        "float64 x\nfloat64 x\n",
        "float64[ x\n",
        "float64[-1] x\n",
        "float64<=3 x\n",
        "Missing x\n",
        "Top x\n",
        "A x\n================================================================================\nMSG: pkg/A\nTop y\n",
        "================================================================================\nnot a name\n",
    ] {
        let error = parse_error(text);
        assert!(
            matches!(error, DatasetError::Corrupt { .. }),
            "{text}: {error}"
        );
    }
    let line = "=".repeat(80);
    let deep: String = (0..100)
        .map(|i| format!("T{i} x\n{line}\nMSG: pkg/T{i}\n"))
        .collect();
    assert!(matches!(
        parse_error(&format!("{deep}uint8 x\n")),
        DatasetError::Corrupt { .. }
    ));
}

#[test]
fn ros1_times_and_headers_are_built_in() {
    let types = ros1("Header header\nduration d\nbyte b\nstring s\n");
    assert_eq!(
        names(&types.describe()),
        [
            "header.seq",
            "header.stamp",
            "header.frame_id",
            "d",
            "b",
            "s"
        ]
    );
    let message = |secs: u32| {
        let words = [1, secs, 5, 0, (-2_i32).cast_unsigned(), 7];
        let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        bytes.push(0xFF);
        bytes.extend([2, 0, 0, 0, b'h', b'i']);
        bytes
    };
    // Seconds are unsigned: they last until 2106.
    let bytes = message(3_000_000_000);
    let paths = ["header.stamp", "d", "b", "s", "header.stamp.secs"];
    let out = extract(&types, &paths, &bytes).unwrap();
    assert_eq!(out.slots()[0].time_ns(), Some(3_000_000_000_000_000_005));
    assert_eq!(out.slots()[1].time_ns(), Some(-1_999_999_993));
    assert_eq!(out.slots()[2].numbers(), [-1.0]);
    assert_eq!(out.slots()[3].texts().collect::<Vec<_>>(), ["hi"]);
    assert_eq!(out.slots()[4].numbers(), [3e9]);
    let mut more = bytes.clone();
    more.push(0);
    assert!(decode(&types, &bytes).is_ok());
    assert!(decode(&types, &more).is_err());
}

#[test]
fn a_stamp_of_zero_is_absent() {
    let types = ros2("std_msgs/Header header\nbuiltin_interfaces/Duration d\n");
    let message = |sec: u32, nanosec: u32| {
        let cdr = Cdr::new(false).u32(sec).u32(nanosec).text("x");
        cdr.u32(0).u32(0).bytes
    };
    let out = extract(&types, &["header.stamp", "d"], &message(0, 0)).unwrap();
    assert!(!out.slots()[0].present());
    assert_eq!(out.slots()[1].time_ns(), Some(0));
    let out = extract(&types, &["header.stamp"], &message(0, 1)).unwrap();
    assert_eq!(out.slots()[0].time_ns(), Some(1));
    let error = extract(&types, &["header.stamp"], &message(1, 1_000_000_000));
    assert!(error.unwrap_err().contains("1000000000 ns"));
}

#[test]
fn paths_that_lead_nowhere_are_refused() {
    let types = Arc::new(ros2(MIXED));
    let plan = |path: &str| RosPlan::new(Arc::clone(&types), &[path.parse().unwrap()]);
    for path in ["z", "h[].z", "a.b"] {
        let error = plan(path).unwrap_err();
        assert!(
            matches!(error, DatasetError::MissingKey { .. }),
            "{path}: {error}"
        );
    }
    for path in ["h", "h[0]", "h[]", "a[0]", "i[2]", "j"] {
        let error = plan(path).unwrap_err();
        assert!(
            matches!(error, DatasetError::WrongType { .. }),
            "{path}: {error}"
        );
    }
    for path in ["", ".a", "a.", "a[", "a[x]", "a[]b[]", "a[][]", "a]"] {
        assert!(path.parse::<FieldPath>().is_err(), "{path}");
    }
    for path in ["a", "a.b", "a[3]", "a[].b", "a[0].b.c"] {
        assert_eq!(path.parse::<FieldPath>().unwrap().to_string(), path);
    }
}
