// What the page says to the server and hears of it; it goes on by itself when the server is back.

export const AWAY = "The server is not reached.";
export const token = crypto.randomUUID();

let socket = null;
let number = 0;
const waiting = new Map();
const listeners = new Set();
const unsent = [];

function connect() {
  socket = new WebSocket(`ws://${location.host}/talk`);
  socket.onopen = () => {
    socket.send(JSON.stringify({ token }));
    for (const message of unsent.splice(0)) socket.send(message);
    tell({ connected: true });
  };
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if ("state" in message) return tell({ state: message.state });
    const found = waiting.get(message.id);
    if (!found) return;
    waiting.delete(message.id);
    if ("wrong" in message) found.reject(new Error(message.wrong));
    else found.resolve(message.answer);
  };
  socket.onclose = () => {
    for (const { reject } of waiting.values()) reject(new Error(AWAY));
    waiting.clear();
    tell({ connected: false });
    setTimeout(connect, 500);
  };
}

const tell = (news) => listeners.forEach((listener) => listener(news));

export function listen(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

export function ask(name, arguments_ = {}) {
  const id = ++number;
  const message = JSON.stringify({ id, ask: name, with: arguments_ });
  const answer = new Promise((resolve, reject) => waiting.set(id, { resolve, reject }));
  if (socket?.readyState === WebSocket.OPEN) socket.send(message);
  else unsent.push(message);
  return answer;
}

connect();
