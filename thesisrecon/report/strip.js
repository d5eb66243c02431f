"use strict";
const pictures = Array.from(document.querySelectorAll(".strip img"));
const shown = document.getElementById("shown");
const place = document.getElementById("place");
const told = document.getElementById("told");
const play = document.getElementById("play");
let timer = 0;
let step = 1;
function show(k) {
  place.value = String(k);
  shown.src = pictures[k].src;
  shown.alt = told.textContent = pictures[k].alt;
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
    if (k + step < 0 || k + step >= pictures.length) { step = -step; }
    if (k + step >= 0 && k + step < pictures.length) { show(k + step); }
  }, 120);
});
