//! A reader of pickles that builds plain data and calls nothing.

use std::collections::BTreeMap;

use super::opcode::{Opcode, refused_name};
use super::storage::{Storage, View, ViewProblem};

/// Bytes of a text, at most: names of tensors have less than a hundred.
const MAX_TEXT: usize = 1 << 8;
/// Bytes of a storage's key, at most: keys are counted.
const MAX_KEY: usize = 32;
/// Objects of a pickle, at most, and those that lie on the stack at once: 200 tensors take 5000.
const MAX_OBJECTS: usize = 1 << 16;
/// Marks that are open at once, at most.
const MAX_MARKS: usize = 64;

/// Place of an object among those of a pickle.
pub(super) type Handle = usize;

/// What a pickle can build here.
#[derive(Debug)]
pub(super) enum Object {
    Int(i64),
    False,
    Text(String),
    Tuple(Vec<Handle>),
    /// A dict, ordered or not; keys are texts.
    Dict(Vec<(Handle, Handle)>),
    Function(Function),
    Storage(Box<Storage>),
    Tensor(Box<View>),
}

/// The names that a pickle may look up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Function {
    OrderedDict,
    RebuildTensor,
    StorageType(super::storage::NumberType),
}

impl Function {
    fn of(module: &str, name: &str) -> Option<Self> {
        use super::storage::NumberType;
        Some(match (module, name) {
            ("collections", "OrderedDict") => Self::OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2") => Self::RebuildTensor,
            ("torch", "FloatStorage") => Self::StorageType(NumberType::F32),
            ("torch", "HalfStorage") => Self::StorageType(NumberType::F16),
            ("torch", "BFloat16Storage") => Self::StorageType(NumberType::Bf16),
            ("torch", "DoubleStorage") => Self::StorageType(NumberType::F64),
            _ => return None,
        })
    }
}

/// Everything that a pickle built; objects may be in several others, and in themselves.
#[derive(Debug)]
pub(super) struct Pickled {
    objects: Vec<Object>,
    root: Handle,
}

impl Pickled {
    /// What the pickle stands for.
    pub(super) fn root(&self) -> &Object {
        &self.objects[self.root]
    }

    /// The text at a key of a dict.
    pub(super) fn text(&self, handle: Handle) -> &str {
        match &self.objects[handle] {
            Object::Text(text) => text,
            _ => "",
        }
    }

    /// An object within another.
    pub(super) fn get(&self, handle: Handle) -> &Object {
        &self.objects[handle]
    }
}

impl Object {
    /// What it is, for messages.
    pub(super) fn kind(&self) -> &'static str {
        match self {
            Self::Int(_) => "a number",
            Self::False => "False",
            Self::Text(_) => "a text",
            Self::Tuple(_) => "a tuple",
            Self::Dict(_) => "a dict",
            Self::Function(_) => "a function",
            Self::Storage(_) => "a storage",
            Self::Tensor(_) => "a tensor",
        }
    }
}

/// What is wrong, at which byte.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Refusal {
    pub(super) offset: usize,
    pub(super) problem: String,
}

/// Reads a pickle.
pub(super) fn read(bytes: &[u8]) -> Result<Pickled, Refusal> {
    let mut reader = Reader {
        bytes,
        place: 0,
        objects: Vec::new(),
        stack: Vec::new(),
        marks: Vec::new(),
        memo: BTreeMap::new(),
    };
    loop {
        let offset = reader.place;
        match reader.step() {
            Ok(None) => {}
            Ok(Some(root)) => {
                let objects = reader.objects;
                return Ok(Pickled { objects, root });
            }
            Err(problem) => return Err(Refusal { offset, problem }),
        }
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
    place: usize,
    objects: Vec<Object>,
    stack: Vec<Handle>,
    /// Heights of the stack at the open marks.
    marks: Vec<usize>,
    memo: BTreeMap<u32, Handle>,
}

impl Reader<'_> {
    /// One instruction; the result after the last.
    fn step(&mut self) -> Result<Option<Handle>, String> {
        let is_first = self.place == 0;
        let [byte] = self.take()?;
        let Some(opcode) = Opcode::of(byte) else {
            let name = refused_name(byte);
            return Err(format!(
                "the instruction {name} (0x{byte:02x}) is refused: no file of tensors needs it"
            ));
        };
        if is_first != (opcode == Opcode::Proto) {
            return Err("expected PROTO as the first instruction and nowhere else".to_owned());
        }
        match opcode {
            Opcode::Proto => match self.take()? {
                [2] => {}
                [found] => return Err(format!("protocol {found}, expected 2")),
            },
            Opcode::EmptyDict => self.push(Object::Dict(Vec::new()))?,
            Opcode::EmptyTuple => self.push(Object::Tuple(Vec::new()))?,
            Opcode::Mark => self.mark()?,
            Opcode::Tuple => {
                let items = self.pop_to_mark()?;
                self.push(Object::Tuple(items))?;
            }
            Opcode::Tuple1 => self.tuple(1)?,
            Opcode::Tuple2 => self.tuple(2)?,
            Opcode::Tuple3 => self.tuple(3)?,
            Opcode::BinUnicode => {
                let text = self.text()?;
                self.push(Object::Text(text))?;
            }
            Opcode::BinInt => {
                let number = i32::from_le_bytes(self.take()?);
                self.push(Object::Int(number.into()))?;
            }
            Opcode::BinInt1 => {
                let [number] = self.take()?;
                self.push(Object::Int(number.into()))?;
            }
            Opcode::BinInt2 => {
                let number = u16::from_le_bytes(self.take()?);
                self.push(Object::Int(number.into()))?;
            }
            Opcode::BinPut | Opcode::LongBinPut => {
                let key = self.memo_key(opcode == Opcode::LongBinPut)?;
                let top = self.top()?;
                if self.memo.len() == MAX_OBJECTS {
                    return Err(format!("more than {MAX_OBJECTS} objects stored"));
                }
                self.memo.insert(key, top);
            }
            Opcode::BinGet | Opcode::LongBinGet => {
                let key = self.memo_key(opcode == Opcode::LongBinGet)?;
                let found = self.memo.get(&key).copied();
                let handle = found.ok_or_else(|| format!("nothing was stored as {key}"))?;
                self.put(handle)?;
            }
            Opcode::NewFalse => self.push(Object::False)?,
            Opcode::Global => self.global()?,
            Opcode::BinPersId => self.storage()?,
            Opcode::Reduce => self.reduce()?,
            Opcode::Build => self.build()?,
            Opcode::SetItem => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set_items(&[key, value])?;
            }
            Opcode::SetItems => {
                let items = self.pop_to_mark()?;
                self.set_items(&items)?;
            }
            Opcode::Stop => return self.stop().map(Some),
        }
        Ok(None)
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let rest = &self.bytes[self.place..];
        let taken = rest.first_chunk::<N>().ok_or("it ends here, unfinished")?;
        self.place += N;
        Ok(*taken)
    }

    fn push(&mut self, object: Object) -> Result<(), String> {
        if self.objects.len() == MAX_OBJECTS {
            return Err(format!("more than {MAX_OBJECTS} objects"));
        }
        self.put(self.objects.len())?;
        self.objects.push(object);
        Ok(())
    }

    fn put(&mut self, handle: Handle) -> Result<(), String> {
        if self.stack.len() == MAX_OBJECTS {
            return Err(format!("more than {MAX_OBJECTS} objects on its stack"));
        }
        self.stack.push(handle);
        Ok(())
    }

    fn mark(&mut self) -> Result<(), String> {
        if self.marks.len() == MAX_MARKS {
            return Err(format!("more than {MAX_MARKS} open marks"));
        }
        self.marks.push(self.stack.len());
        Ok(())
    }

    /// The top of the stack that lies above the last mark.
    fn top(&self) -> Result<Handle, String> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let above = &self.stack[floor..];
        let top = above.last().copied();
        top.ok_or_else(|| "takes from an empty stack".to_owned())
    }

    fn pop(&mut self) -> Result<Handle, String> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Handle>, String> {
        let mark = self.marks.pop().ok_or("there is no open mark")?;
        Ok(self.stack.split_off(mark))
    }

    fn tuple(&mut self, n: usize) -> Result<(), String> {
        let mut items = Vec::with_capacity(n);
        for _ in 0..n {
            items.push(self.pop()?);
        }
        items.reverse();
        self.push(Object::Tuple(items))?;
        Ok(())
    }

    fn text(&mut self) -> Result<String, String> {
        let n = u32::from_le_bytes(self.take()?) as usize;
        if n > MAX_TEXT {
            return Err(format!("a text of {n} bytes, expected {MAX_TEXT} at most"));
        }
        let rest = &self.bytes[self.place..];
        let text = rest.get(..n).ok_or("it ends within a text")?;
        let text = str::from_utf8(text).map_err(|_| "a text that is not UTF-8")?;
        // Names are shown, and a terminal obeys what it is shown.
        if text.chars().any(char::is_control) {
            return Err("a text with control characters".to_owned());
        }
        self.place += n;
        Ok(text.to_owned())
    }

    fn memo_key(&mut self, is_long: bool) -> Result<u32, String> {
        if is_long {
            return Ok(u32::from_le_bytes(self.take()?));
        }
        let [key] = self.take()?;
        Ok(key.into())
    }

    /// A line, without its end.
    fn line(&mut self) -> Result<String, String> {
        let rest = &self.bytes[self.place..];
        let within = &rest[..rest.len().min(MAX_TEXT)];
        let end = within.iter().position(|&byte| byte == b'\n');
        let end = end.ok_or("a name without an end")?;
        self.place += end + 1;
        let name = &rest[..end];
        if !name.iter().all(u8::is_ascii_graphic) {
            return Err("a name that is not of letters and signs".to_owned());
        }
        Ok(String::from_utf8_lossy(name).into_owned())
    }

    fn global(&mut self) -> Result<(), String> {
        let (module, name) = (self.line()?, self.line()?);
        let Some(function) = Function::of(&module, &name) else {
            return Err(format!(
                "the name {:?} is refused: no file of tensors needs it",
                format!("{module}.{name}")
            ));
        };
        self.push(Object::Function(function))?;
        Ok(())
    }

    /// Of `("storage", type, key, device, numbers)` a storage; the device does not matter.
    fn storage(&mut self) -> Result<(), String> {
        let id = self.pop()?;
        let Object::Tuple(items) = &self.objects[id] else {
            let found = self.objects[id].kind();
            return Err(format!("{found} as the id of a storage, expected a tuple"));
        };
        let items: Vec<&Object> = items.iter().map(|&item| &self.objects[item]).collect();
        let [
            Object::Text(tag),
            Object::Function(Function::StorageType(numbers)),
            Object::Text(key),
            Object::Text(_),
            Object::Int(n),
        ] = items[..]
        else {
            return Err("the id of a storage is not (text, type, key, device, numbers)".to_owned());
        };
        if key.len() > MAX_KEY {
            let n = key.len();
            return Err(format!("a key of {n} bytes, expected {MAX_KEY} at most"));
        }
        if tag != "storage" {
            return Err(format!("the id of a {tag:?}, expected a \"storage\""));
        }
        let n_numbers = usize::try_from(*n).map_err(|_| format!("a storage of {n} numbers"))?;
        let storage = Storage {
            key: key.clone(),
            numbers: *numbers,
            n_numbers,
        };
        self.push(Object::Storage(Box::new(storage)))?;
        Ok(())
    }

    fn reduce(&mut self) -> Result<(), String> {
        let (arguments, function) = (self.pop()?, self.pop()?);
        let Object::Tuple(arguments) = &self.objects[arguments] else {
            let found = self.objects[arguments].kind();
            return Err(format!("calls with {found}, expected a tuple"));
        };
        let made = match &self.objects[function] {
            Object::Function(Function::OrderedDict) if arguments.is_empty() => {
                Object::Dict(Vec::new())
            }
            Object::Function(Function::OrderedDict) => {
                let n = arguments.len();
                return Err(format!("an OrderedDict of {n} arguments, expected none"));
            }
            Object::Function(Function::RebuildTensor) => {
                Object::Tensor(Box::new(self.tensor(arguments)?))
            }
            other => return Err(format!("calls {}", other.kind())),
        };
        self.push(made)?;
        Ok(())
    }

    /// Of `(storage, offset, shape, strides, False, hooks)` a tensor.
    fn tensor(&self, arguments: &[Handle]) -> Result<View, String> {
        let arguments: Vec<&Object> = arguments.iter().map(|&a| &self.objects[a]).collect();
        let [
            Object::Storage(storage),
            Object::Int(offset),
            Object::Tuple(shape),
            Object::Tuple(strides),
            Object::False,
            Object::Dict(hooks),
        ] = arguments[..]
        else {
            return Err(
                "a tensor is not of (storage, offset, shape, strides, False, hooks)".to_owned(),
            );
        };
        if !hooks.is_empty() {
            return Err("a tensor with hooks".to_owned());
        }
        let offset = usize::try_from(*offset).map_err(|_| format!("an offset of {offset}"))?;
        let (shape, strides) = (self.numbers(shape)?, self.numbers(strides)?);
        View::new(Storage::clone(storage), offset, shape, strides)
            .map_err(|ViewProblem(problem)| problem)
    }

    fn numbers(&self, tuple: &[Handle]) -> Result<Vec<usize>, String> {
        let number = |&handle: &Handle| match &self.objects[handle] {
            Object::Int(n) => usize::try_from(*n).map_err(|_| format!("a size of {n}")),
            other => Err(format!("{} as a size, expected a number", other.kind())),
        };
        tuple.iter().map(number).collect()
    }

    /// What PyTorch hangs on a state dict tells the versions of its modules: it is left out.
    fn build(&mut self) -> Result<(), String> {
        let (state, object) = (self.pop()?, self.top()?);
        match (&self.objects[object], &self.objects[state]) {
            (Object::Dict(_), Object::Dict(_)) => Ok(()),
            (object, state) => {
                let (object, state) = (object.kind(), state.kind());
                Err(format!(
                    "sets the state of {object} to {state}, expected two dicts"
                ))
            }
        }
    }

    fn set_items(&mut self, items: &[Handle]) -> Result<(), String> {
        let (pairs, []) = items.as_chunks::<2>() else {
            return Err("a key without a value".to_owned());
        };
        let key = |pair: &[Handle; 2]| &self.objects[pair[0]];
        let other = |key: &&Object| !matches!(key, Object::Text(_));
        if let Some(found) = pairs.iter().map(key).find(other) {
            return Err(format!("{} as a key, expected a text", found.kind()));
        }
        let top = self.top()?;
        let Object::Dict(dict) = &mut self.objects[top] else {
            let found = self.objects[top].kind();
            return Err(format!("sets items of {found}, expected a dict"));
        };
        dict.extend(pairs.iter().map(|&[key, value]| (key, value)));
        Ok(())
    }

    fn stop(&mut self) -> Result<Handle, String> {
        let root = self.pop()?;
        if !self.stack.is_empty() || !self.marks.is_empty() {
            return Err("it ends with more than one result".to_owned());
        }
        let left = self.bytes.len() - self.place;
        if left > 0 {
            return Err(format!("{left} bytes after its end"));
        }
        Ok(root)
    }
}
