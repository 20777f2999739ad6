// Sets light or dark before anything is drawn: as chosen here before, else as the computer says.
{
  let chosen = null;
  try { chosen = localStorage.getItem("theme"); } catch { /* the browser keeps nothing: then as the computer says */ }
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
}
