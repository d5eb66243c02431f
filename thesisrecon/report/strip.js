"use strict";
const frames = Array.from(document.querySelectorAll(".strip img"));
const shown = document.getElementById("shown");
const place = document.getElementById("place");
const caption = document.getElementById("caption");
const play = document.getElementById("play");
let timer = 0;
let step = 1;
function show(k) {
  place.value = String(k);
  shown.src = frames[k].src;
  shown.alt = caption.textContent = frames[k].alt;
}
function stop() {
  clearInterval(timer);
  timer = 0;
  play.textContent = "Play";
}
place.addEventListener("input", () => { stop(); show(Number(place.value)); });
play.addEventListener("click", () => {
  if (timer) { stop(); return; }
  play.textContent = "Stop";
  timer = setInterval(() => {
    const k = Number(place.value);
    if (k + step < 0 || k + step >= frames.length) { step = -step; }
    if (k + step >= 0 && k + step < frames.length) { show(k + step); }
  }, 120);
});
