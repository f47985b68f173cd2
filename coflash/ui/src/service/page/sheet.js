// Has the report of the machine printed. A browser prints the address of the page, too, and that has the token.

history.replaceState(null, "", "/");
addEventListener("load", () => print());
