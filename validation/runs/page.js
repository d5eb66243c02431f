"use strict";
// Draws the plots of the page from the JSON beside this script.
(function () {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  Object.keys(figures).forEach(function (id) {
    const figure = figures[id], element = document.getElementById(id);
    Plotly.newPlot(element, figure.data, figure.layout, { displaylogo: false, responsive: true }).then(function () {
      element.dataset.drawn = "";
    }).catch(function (error) {
      element.classList.add("broken");
      element.textContent = "This plot could not be drawn: " + error.message;
    });
  });
})();
